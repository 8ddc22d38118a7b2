"""Pictures: pixels as means over their area, for chunks of any size."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from nerfloom.base.config import RayConfig
from nerfloom.cameras.cameras import Cameras, subpixels
from nerfloom.cameras.view import View
from nerfloom.data.pixels.batch import PixelBatch
from nerfloom.data.scene import Scene
from nerfloom.data.sources import PixelSource, Request
from nerfloom.evaluation import evaluator
from nerfloom.evaluation.evaluator import Evaluation, evaluate
from nerfloom.fields.base import Field
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.ray_model import RayModel
from nerfloom.rendering.rendered import Rendered
from nerfloom.rendering.renderer import Renderer
from nerfloom.samplers.uniform import UniformSampler
from tests.training.helpers import tiny_trainer

SIZE = 12


def inside(x: Tensor, y: Tensor) -> Tensor:
    """1 inside a circle at the picture's middle, 0 outside: an edge of every slope."""
    return ((x - 0.01).square() + (y + 0.02).square() < 0.2**2).float()


class Nothing(Field):
    """Asked by nobody: the renderer draws without it."""

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        raise AssertionError

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        raise AssertionError


class Disc(Renderer):
    """White where `inside`, and the background elsewhere."""

    def __init__(self) -> None:
        super().__init__()
        self.anything = torch.nn.Parameter(torch.zeros(1))
        self.seen: list[int] = []

    def render(self, rays: Rays, samples: Samples, field: Field, background: Tensor) -> Rendered:
        assert rays.camera_indices is None
        self.seen.append(len(rays))
        x, y = (-rays.directions[:, i] / rays.directions[:, 2] for i in (0, 1))
        white = inside(x, y)
        rgb = white[:, None] + (1 - white[:, None]) * background
        return Rendered(rgb, white, white, white, 0)


def disc(config: RayConfig) -> RayModel[RayConfig]:
    scene = Scene(torch.zeros(2, 3), 0.0, 9.0, 1, True, False, SIZE)
    return RayModel(config, scene, Nothing(), UniformSampler(1), Disc())


def picture(rays_per_pixel: int, chunk: int = 8192) -> Tensor:
    one = [torch.tensor([v]) for v in (20.0, 20.0, SIZE / 2, SIZE / 2)]
    cameras = Cameras(torch.eye(4)[None, :3], *one, torch.tensor([SIZE]), torch.tensor([SIZE]))
    model = disc(RayConfig(rays_per_pixel=rays_per_pixel, eval_num_rays_per_chunk=chunk))
    image = model.render_view(View.of(cameras, 0), torch.full((3,), 0.25))
    seen = model.renderer.seen
    assert image.num_rays == sum(seen) == SIZE**2 * rays_per_pixel
    assert max(seen) <= max(chunk, rays_per_pixel)
    return image.rgb


def test_a_pixel_is_the_mean_over_its_area() -> None:
    """Against the disc's exact coverage, from 64 x 64 places a pixel: the error falls as the rays grow."""
    step = (torch.arange(SIZE * 64) + 0.5) / 64 - SIZE / 2
    x, y = step[None, :] / 20, -step[:, None] / 20
    cover = inside(x, y).view(SIZE, 64, SIZE, 64).mean((1, 3))
    exact = (cover + (1 - cover) * 0.25)[..., None].expand(-1, -1, 3)
    errors = {count: float((picture(count) - exact).square().mean().sqrt()) for count in (1, 4, 9, 16)}
    assert errors[4] < errors[1] / 2.5
    assert errors[16] < errors[4] / 2


@pytest.mark.parametrize("chunk", [1, 30, 100])
def test_chunks_change_nothing(chunk: int) -> None:
    torch.testing.assert_close(picture(4, chunk), picture(4), rtol=0, atol=0)


def test_training_averages_the_same_rays_late_in_the_budget(shared_tiny: Path, tmp_path: Path) -> None:
    settings = {"max_num_iterations": 8, "rays_per_pixel": 4, "train_rays_per_pixel_from": 0.5}
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", **settings)
    batches: list[PixelBatch] = []

    class Recording(PixelSource):
        def draw(self, request: Request) -> PixelBatch:
            batches.append(super().draw(request))
            return batches[-1]

    backgrounds: list[Tensor] = []
    render = trainer.model.render

    def watched(rays: Rays, background: Tensor) -> Rendered:
        backgrounds.append(background)
        return render(rays, background)

    trainer.prepare()
    trainer.source = Recording(trainer.train_set, "random", trainer.config.machine.seed)
    trainer.model.render, trainer.model.plain = watched, False
    trainer.train()
    scene = trainer.train_set.scene
    for step, (batch, background) in enumerate(zip(batches, backgrounds, strict=True)):
        places = subpixels(4 if step >= 4 else 1)
        expected = trainer.train_set.cameras.pixel_rays(batch.pixels, scene.near, scene.far, None, places)
        torch.testing.assert_close(batch.rays.directions, expected.directions)
        torch.testing.assert_close(background, batch.background.repeat_interleave(len(places), 0))
    assert len(batches) == 8
    assert trainer.state.rays == sum(len(batch.rays) for batch in batches)


def test_means_over_pixels_are_means() -> None:
    def made() -> Rendered:
        return Rendered(torch.rand(12, 3), torch.rand(12), torch.rand(12), torch.rand(12), 5)

    rays = made().over(made())
    rays.accumulation[4:7] = 0  # of the second pixel only the last ray meets anything
    assert rays.num_samples == 10
    assert rays.coarse is not None
    pixels, coarse = rays.to_pixels(4), rays.coarse.to_pixels(4)
    for one, two in ((pixels, rays), (coarse, rays.coarse)):
        torch.testing.assert_close(one.rgb, torch.stack([two.rgb[i : i + 4].mean(0) for i in (0, 4, 8)]))
        torch.testing.assert_close(one.accumulation, two.accumulation.view(3, 4).mean(1))
        torch.testing.assert_close(one.median_depth, two.median_depth.view(3, 4).sort(1).values[:, 1])
        for pixel, group in enumerate((slice(0, 4), slice(4, 8), slice(8, 12))):
            share, depth = two.accumulation[group], two.depth[group]
            torch.testing.assert_close(one.depth[pixel], (share * depth).sum() / share.sum())
    torch.testing.assert_close(pixels.depth[1], rays.depth[7])
    alone = rays.to_pixels(1)
    for name in ("rgb", "depth", "median_depth", "accumulation"):
        assert getattr(alone, name) is getattr(rays, name)


@pytest.mark.parametrize(
    ("asked", "alpha", "expected"),
    [
        ("auto", True, 1.0),
        ("random", True, 1.0),
        ("white", True, 1.0),
        ("black", True, 0.0),
        ("auto", False, 0.0),
        ("random", False, 0.0),
        ("white", False, 1.0),  # white parts may have been learnt as empty
        ("black", False, 0.0),
    ],
)
def test_pictures_are_over_what_training_was_over(asked: Any, alpha: bool, expected: float) -> None:
    model = disc(RayConfig(background=asked))
    model.scene = replace(model.scene, has_alpha=alpha)
    assert model.background.tolist() == [expected] * 3


def test_pictures_are_of_views_evenly_spaced_and_of_the_worst(shared_tiny: Path, tmp_path: Path) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run")
    images = trainer.train_set
    found = evaluate(trainer.model, images, pictures=tmp_path / "two", max_pictures=2)
    evaluate(trainer.model, images, pictures=tmp_path / "all")
    views = {path.name.split("_")[0].removesuffix(".png") for path in (tmp_path / "two").iterdir()}
    assert views == {"0000", f"{len(images) // 2:04d}", "worst"}
    worst = min(range(len(images)), key=lambda index: found.per_image[index]["psnr"])
    (expected,) = (tmp_path / "all").glob(f"{worst:04d}_*_photograph.png")
    assert (tmp_path / "two" / "worst_photograph.png").read_bytes() == expected.read_bytes()
    assert not list((tmp_path / "all").glob("worst*"))
    assert found.results["num_rays_per_sec"] > 0
    evaluate(trainer.model, images, max_images=2, pictures=tmp_path / "none", max_pictures=0)
    assert not (tmp_path / "none").exists()


def test_as_many_images_as_fit_the_time_evenly_spaced_and_it_is_said(
    shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The time of the first image decides: 3 s each, of 10 s."""
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run")
    images, timed = trainer.train_set, evaluator._timed
    monkeypatch.setattr(evaluator, "_timed", lambda work, title: (timed(work, title)[0], 3.0))
    whole = evaluate(trainer.model, images)
    assert "evaluating" not in capsys.readouterr().err
    found = evaluate(trainer.model, images, seconds=10.0, pictures=tmp_path / "two", max_pictures=2)
    assert f"evaluating 3 of {len(images)} images, 3 s each" in capsys.readouterr().err
    third = [index * len(images) // 3 for index in range(3)]
    without_time = [{name: value for name, value in row.items() if name != "seconds"} for row in whole.per_image]
    assert [without_time[index] for index in third] == [
        {name: value for name, value in row.items() if name != "seconds"} for row in found.per_image
    ]
    assert (found.results["num_images"], found.results["num_images_in_split"]) == (3, len(images))
    assert found.line().endswith(f"(3 of {len(images)} images)")
    assert whole.line().endswith(f"({len(images)} images)")
    assert {path.name[:4] for path in (tmp_path / "two").iterdir()} == {f"{third[0]:04d}", f"{third[1]:04d}", "wors"}
    assert len(evaluate(trainer.model, images, seconds=0.1).per_image) == 1
    assert len(evaluate(trainer.model, images, seconds=1e9, max_images=4).per_image) == 4


def test_views_with_pictures_come_first(shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run")
    names, judge, seen = trainer.train_set.names, evaluator._judge, []

    def recorded(*arguments: Any) -> Any:
        seen.append(arguments[-1])
        return judge(*arguments)

    monkeypatch.setattr(evaluator, "_judge", recorded)
    found = evaluate(trainer.model, trainer.train_set, pictures=tmp_path / "two", max_pictures=2)
    assert seen[:2] == [0, len(names) // 2]
    assert sorted(seen) == list(range(len(names)))
    assert tuple(row["name"] for row in found.per_image) == tuple(names)


def test_views_far_below_the_mean_are_named() -> None:
    psnrs = {"a.jpg": 31.0, "b.jpg": 13.5, "c.jpg": 30.0, "d.jpg": 21.25, "e.jpg": 35.0, "f.jpg": 33.0}
    rows = [{"name": name, "psnr": psnr} for name, psnr in psnrs.items()]
    mean = sum(psnrs.values()) / len(psnrs)  # 27.29
    assert Evaluation(rows, {"psnr": mean}, "").far_below == "far below the mean: b.jpg 13.50 dB, d.jpg 21.25 dB"
    assert Evaluation(rows[:1], {"psnr": 31.0}, "").far_below is None
    many = [*rows, *({"name": f"{n}.jpg", "psnr": 10.0 + n} for n in range(3))]
    assert Evaluation(many, {"psnr": mean}, "").far_below == (
        "far below the mean: 0.jpg 10.00 dB, 1.jpg 11.00 dB, 2.jpg 12.00 dB, and 2 more"
    )
    assert Evaluation([{"name": "a.jpg", "psnr": math.nan}], {"psnr": math.nan}, "").far_below is None


def test_a_picture_that_is_not_finite_has_metrics_that_are_not(shared_tiny: Path, tmp_path: Path) -> None:
    """A pose that is NaN gives one: the evaluation ends, and says so in its figures."""
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", evaluated=True)
    assert trainer.eval_set is not None
    poses = trainer.eval_set.cameras.camera_to_worlds.clone()
    poses[0] = torch.nan
    pictures = trainer.model.render_view
    trainer.model.render_view = lambda view, background: (  # type: ignore[method-assign]
        replace(found := pictures(view, background), rgb=found.rgb + view.camera.camera_to_worlds.sum() * 0)
    )
    cameras = replace(trainer.eval_set.cameras, camera_to_worlds=poses)
    found = evaluate(trainer.model, replace(trainer.eval_set, cameras=cameras)).results
    assert math.isnan(found["psnr"])
    assert math.isnan(found["psnr_std"])


def test_speeds_are_of_images_and_of_their_rays(shared_tiny: Path, tmp_path: Path) -> None:
    """Both are measured in the same time: an image has 20 x 20 pixels of four rays."""
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", evaluated=True, rays_per_pixel=4)
    found = evaluate(trainer.model, trainer.eval_set)
    seconds = sum(row["seconds"] for row in found.per_image)
    assert found.results["fps"] == pytest.approx(len(found.per_image) / seconds, rel=1e-3)
    assert found.results["num_rays_per_sec"] == pytest.approx(1600 * found.results["fps"], rel=1e-3)
