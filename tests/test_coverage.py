"""Pixels without a ray, against brute force."""

from dataclasses import replace

import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.cameras.cameras import Cameras, join_cameras
from nerfloom.data.coverage import pixels_with_rays, unreachable_pixels
from tests.test_lenses import ALL, FISHEYE, GOPRO, HEIGHT, WIDTH, cameras

BARREL = [-0.5] + [0.0] * 8


def by_brute_force(camera: Cameras) -> torch.Tensor:
    """Every pixel, without the shortcut."""
    flat = torch.arange(int(camera.offsets[-1]))
    indices = torch.searchsorted(camera.offsets, flat, right=True) - 1
    within = flat - camera.offsets[indices]
    found = camera.look(indices, within % camera.widths[indices], within // camera.widths[indices])[2].valid
    return flat[~found]


@pytest.mark.parametrize(("model", "lens"), ALL)
def test_lenses_that_see_everything(model: str, lens: list[float] | None) -> None:
    assert len(unreachable_pixels(cameras(model, lens))) == 0
    assert len(by_brute_force(cameras(model, lens))) == 0


@pytest.mark.parametrize(
    ("model", "lens"),
    [("opencv", BARREL), ("opencv", [-0.4, 0.0, 0.02, -0.03] + [0.0] * 5), ("fisheye", [-0.3, 0.0, 0.0, 0.0])],
)
def test_what_is_left_out_is_what_brute_force_leaves_out(model: str, lens: list[float]) -> None:
    camera = cameras(model, lens)
    lost = unreachable_pixels(camera)
    assert torch.equal(lost, by_brute_force(camera))
    assert 0 < len(lost) < 2 * WIDTH * HEIGHT
    rays = camera.pixel_rays(lost, 0.1, 9.0)
    for value in (rays.origins, rays.directions, rays.pixel_radii):
        assert value is not None
        assert value.isfinite().all()


def test_the_barrel_by_its_closed_form() -> None:
    camera = cameras("opencv", BARREL, count=1)
    rows, columns = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    distance = torch.hypot((columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy)
    beyond = (distance > (2 / 3) ** 0.5 * 2 / 3).reshape(-1).nonzero().squeeze(-1)
    assert torch.equal(unreachable_pixels(camera), beyond)


def test_the_user_is_told_where(capsys: pytest.CaptureFixture[str]) -> None:
    """One camera of three has pixels without rays."""
    camera = join_cameras(
        [cameras("opencv", GOPRO, count=1), cameras("opencv", BARREL, count=1), cameras("pinhole", count=1)]
    )
    kept = pixels_with_rays(camera, ("a.png", "b.png", "c.png"), "train")
    assert kept is not None
    lost = unreachable_pixels(camera)
    assert len(kept) + len(lost) == 3 * WIDTH * HEIGHT
    assert not set(kept.pixels().tolist()) & set(lost.tolist())
    assert ((lost >= WIDTH * HEIGHT) & (lost < 2 * WIDTH * HEIGHT)).all()
    out = " ".join("".join(capsys.readouterr()).split())
    assert f"no ray for {len(lost)} of {3 * WIDTH * HEIGHT} pixels" in out
    assert "on 1 of 3 images, most on b.png" in out


def test_nothing_is_said_where_all_is_well(capsys: pytest.CaptureFixture[str]) -> None:
    assert pixels_with_rays(cameras("fisheye", FISHEYE), ("a.png", "b.png"), "train") is None
    assert "".join(capsys.readouterr()) == ""


def test_a_lens_that_sees_nothing_is_refused() -> None:
    camera = cameras("opencv", BARREL)
    with pytest.raises(DataError, match="no ray for any pixel"):
        pixels_with_rays(replace(camera, cx=camera.cx + 1000), ("a.png", "b.png"), "train")
