"""Which training image lends its light to a held-out view."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfloom import ConfigError, Scene
from nerfloom.cameras.view import View
from nerfloom.evaluation.appearance import held_out_appearance, nearest_camera
from nerfloom.fields.appearance import Appearance
from nerfloom.testing.ball import cameras_at

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
