"""Gaussians and images of wide lenses: which are drawn by the unscented transform, and training on panoramas."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from nerfloom import View
from nerfloom.cameras.cameras import Cameras
from nerfloom.data.pixels.batch import ViewBatch
from nerfloom.geometry.lenses import panorama
from nerfloom.kernels.splats.project import DC
from nerfloom.methods.gaussian_splatting import GaussianSplatting, GaussianSplattingConfig, decide
from nerfloom.splats.drawing import draw_colors, splat_camera
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import Look
from nerfloom.splats.prepared_gaussians import PreparedGaussians
from nerfloom.splats.rasteriser import RASTERISER
from tests.cli.helpers import called
from tests.dataparsers.captures import write_capture
from tests.splats.test_method import SCENE, ball, camera


def panorama_camera(width: int = 64) -> Cameras:
    """A panorama from the place of `camera`: 3 units in front of the origin, which is in its middle."""
    numbers = (torch.tensor([value]) for value in panorama(width, width // 2))
    pose, height = camera().camera_to_worlds, torch.tensor([width // 2])
    return Cameras(pose, *numbers, torch.tensor([width]), height, "equirectangular")


def test_the_lens_decides() -> None:
    """A fisheye of 40 pixels a radian shows 33 degrees at the corners of 33 pixels, and all directions of 201."""
    for model in ("pinhole", "opencv", "fisheye"):
        seen = splat_camera(camera(model), 0.1)
        assert (seen.model, seen.unscented, seen.all_around, seen.turn) == (model, False, False, None)
    size, middle = torch.tensor([201]), torch.tensor([100.5])
    wide = replace(camera("fisheye"), widths=size, heights=size, cx=middle, cy=middle)
    seen = splat_camera(wide, 0.1)
    assert seen.unscented
    assert seen.all_around
    assert seen.turn is None
    narrow = replace(wide, lens=torch.tensor([[-0.3, 0.0, 0.0, 0.0]]))  # which shows nothing beyond 60.4 degrees
    assert not splat_camera(narrow, 0.1).unscented
    seen = splat_camera(panorama_camera(), 0.1)
    assert seen.unscented
    assert seen.turn == pytest.approx(64)


def test_panoramas_are_sorted_by_distance_whatever_gaussians_were_trained_with() -> None:
    """Depth along an axis says nothing about Gaussians beside or behind it."""
    near, far = ball(means=torch.tensor([[3.0, 0.0, 3.0]])), ball(means=torch.tensor([[4.0, 0.0, 3.2]]))
    pair = Gaussians.joined([far, near])
    pair = replace(pair, log_scales=torch.full((2, 3), -1.0), colors=torch.tensor([[-1.0] * 3, [0.5 / DC] * 3]))
    seen = splat_camera(panorama_camera(), 0.1, Look(sort="depth"))
    image = draw_colors(pair, seen, 1, torch.zeros(3))
    assert float(image[16, 47, 0]) > 0.8  # white, to the right: a quarter of the width from the middle


def test_a_picture_is_the_same_when_gaussians_are_prepared() -> None:
    torch.manual_seed(0)
    cloud = Gaussians.joined([ball(0.5, means=3 * torch.randn(1, 3), colors=torch.rand(1, 3)) for _ in range(40)])
    seen, background = splat_camera(panorama_camera(), 0.1), torch.rand(3)
    truth, redrawn = draw_colors(cloud, seen, 1, background), PreparedGaussians(cloud, RASTERISER)
    for _ in range(3):
        torch.testing.assert_close(redrawn.draw(seen, 1, background)[0], truth, rtol=1e-4, atol=1e-4)


def test_growth_counts_both_sides_of_the_seam() -> None:
    """A Gaussian behind the camera is to grow as one in front of it, at the same distance."""
    batch = ViewBatch(0, View(panorama_camera()), torch.full((32, 64, 3), 0.9), torch.zeros(3))
    found = []
    for place in ([0.0, 0.0, 0.0], [0.0, 0.0, 6.0]):
        config, _ = decide(GaussianSplattingConfig(reduced_until=0.0, ssim_weight=0.0), SCENE)
        model = GaussianSplatting(config, SCENE)
        log_scales, harmonics = torch.full((1, 3), -1.0), torch.zeros(1, 3, 15)
        model.set_gaussians(ball(0.0, means=torch.tensor([place]), log_scales=log_scales, harmonics=harmonics))
        model.loss(batch, 0).total.backward()
        assert all(bool(p.grad.isfinite().all()) for p in model.parameters() if p.grad is not None)
        model.after_every_step(0, 0.0, finite=True)
        found.append(float(model.strategy.gradients.take(1)))
    assert found[0] > 0
    assert found[1] == pytest.approx(found[0], rel=0.01)


@pytest.mark.medium
@pytest.mark.parametrize("model", ["EQUIRECTANGULAR", "OPENCV_FISHEYE"])
def test_wide_images_are_learnt_from_as_they_are(model: str, tmp_path: Path) -> None:
    changes = {"fl_x": 10.0, "fl_y": 10.0} if model == "OPENCV_FISHEYE" else {}
    data = write_capture(tmp_path / "wide", 8, camera_model=model, **changes)
    words = ("--data", data, "--output-dir", tmp_path / "out", "--vis", "none", "--max-num-iterations", 3)
    few = ("--start", "random", "--num-gaussians", 300)
    done = called("ns-train", "gaussian-splatting", *words, *few)
    assert done.returncode == 0, done.stderr
