"""Which training image lends its light to a held-out view, and a known light that half of an image tells."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfloom import ConfigError, Scene
from nerfloom.base.config import AppearanceConfig
from nerfloom.cameras.view import View
from nerfloom.data.pixels.batch import gather_batch
from nerfloom.evaluation.appearance import fit_appearance, held_out_appearance, nearest_camera
from nerfloom.fields.appearance import Appearance
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.color import to_linear, to_srgb
from nerfloom.rendering.light import Light, make_light
from nerfloom.rendering.rendered import Rendered
from nerfloom.testing.ball import cameras_at
from nerfloom.testing.scenes import ball_in_a_box
from tests.exact_ball import ExactBall

POSITIONS = torch.tensor([[4.0, 0, 1], [0.0, 4, 1], [-4.0, 0, 1], [0.0, -4, 1]])


def scene(poses: Tensor | None) -> Scene:
    box = torch.tensor([[-1.5] * 3, [1.5] * 3])
    return Scene(
        box=box, near=1.0, far=6.0, num_cameras=4, has_alpha=False, moving=False, image_size=8, camera_to_worlds=poses
    )


def test_the_nearest_camera_is_near_and_looks_the_same_way() -> None:
    cameras = cameras_at(POSITIONS, 40, 8)
    known = scene(cameras.camera_to_worlds)
    for index in range(4):
        assert nearest_camera(known, View.of(cameras, index)) == index
        moved = cameras_at(POSITIONS[index : index + 1] + 0.3, 40, 8)
        assert nearest_camera(known, View.of(moved, 0)) == index
    poses = cameras.camera_to_worlds[:1].repeat(4, 1, 1)  # all in one place, turned about the vertical
    for index, angle in enumerate(torch.arange(4) * torch.pi / 2):
        c, s = angle.cos(), angle.sin()
        turn = torch.stack([torch.stack([c, -s, 0 * c]), torch.stack([s, c, 0 * c]), torch.tensor([0.0, 0, 1])])
        poses[index, :, :3] = turn @ poses[index, :, :3]
    panorama = scene(poses)
    for index in range(4):
        view = View(replace(cameras[:1], camera_to_worlds=poses[index : index + 1]))
        assert nearest_camera(panorama, view) == index
    with pytest.raises(ConfigError, match="--eval-appearance"):
        nearest_camera(scene(None), View.of(cameras, 0))


class Lit:
    """Something with an appearance of each training image, and images of it."""

    def __init__(self) -> None:
        self.cameras = cameras_at(POSITIONS, 40, 8)
        self.scene = scene(self.cameras.camera_to_worlds)
        self.appearance = Appearance(2, 4, held_out="nearest")
        with torch.no_grad():
            self.appearance.vectors.copy_(torch.arange(8.0).view(4, 2))

    def view(self, index: int) -> View:
        return View.of(self.cameras, index)

    def refined_poses(self, poses: torch.Tensor, training: bool) -> torch.Tensor:
        return poses


def test_a_view_has_the_light_of_the_nearest_image() -> None:
    lit = Lit()
    for index in range(4):
        with held_out_appearance(lit, lit, index, torch.zeros(3)):  # type: ignore[arg-type]
            assert lit.appearance(None, 1)[0].tolist() == [2 * index, 2 * index + 1]
    torch.testing.assert_close(lit.appearance(None, 1)[0], torch.tensor([3.0, 4.0]))


class LitBall(ExactBall):
    """A ball in a light."""

    def __init__(self, kind: str, scene: Scene) -> None:
        super().__init__(scene)
        light = make_light(AppearanceConfig(appearance=kind), scene)  # type: ignore[arg-type]
        assert light is not None
        self.light = light

    @property
    def appearance(self) -> Light:
        return self.light

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        shown = super().render(rays, background)
        return replace(shown, rgb=self.light.lit(shown.rgb, shown.accumulation, background))


@pytest.mark.parametrize("kind", ["affine", "tone", "grid"])
def test_half_of_an_image_tells_a_known_light(kind: str) -> None:
    """The colours of the ball's right half are others, and are right too. Shared parameters stay as they are."""
    still, behind = ball_in_a_box(40), torch.zeros(3)
    gains, colors = torch.tensor([0.5, 0.4, 0.45]), still.pixels[:, :3].float() / 255
    dark = to_srgb(gains**2.2 * to_linear(colors)) if kind == "tone" else gains * colors
    pixels = torch.cat([(255 * dark).round().to(torch.uint8), still.pixels[:, 3:]], -1)
    dataset, model = replace(still, pixels=pixels), LitBall(kind, still.scene)
    halves = dataset.cameras.image_pixels(2).view(40, 40).split(20, 1)

    def off(vector: Tensor, half: Tensor) -> float:
        batch = gather_batch(dataset, half.reshape(-1), behind.repeat(half.numel(), 1))
        with model.appearance.shown(vector), torch.no_grad():
            shown = model.render(replace(batch.rays, camera_indices=None), behind)
        return float((shown.rgb - batch.rgb)[shown.accumulation > 0.5].square().mean().sqrt())

    found = fit_appearance(model, dataset, halves[0].reshape(-1), behind)
    assert found is not None
    mean = model.appearance.of_images().detach().mean(0)
    print([off(vector, half) for vector in (mean, found) for half in halves])
    assert off(mean, halves[1]) > 0.2
    assert off(found, halves[1]) < 0.02
    assert torch.equal(found[model.appearance.size :], mean[model.appearance.size :])
