"""Cameras of several kinds made one set."""

import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.cameras.cameras import join_cameras
from tests.test_lenses import FISHEYE, GOPRO, cameras


def test_pinhole_and_opencv_become_opencv() -> None:
    parts = [cameras("pinhole", count=2), cameras("opencv", GOPRO, count=3), cameras("opencv", None, count=1)]
    joined = join_cameras(parts)
    assert joined.model == "opencv"
    assert joined.lens is not None
    torch.testing.assert_close(joined.lens, torch.tensor([[0.0] * 9] * 2 + [GOPRO] * 3 + [[0.0] * 9]))
    start = 0
    for part in parts:
        rays = part.pixel_rays_reference(torch.arange(9), 0.1, 9.0)
        same = joined[torch.arange(start, start + len(part))].pixel_rays_reference(torch.arange(9), 0.1, 9.0)
        torch.testing.assert_close(same.directions, rays.directions)
        torch.testing.assert_close(same.origins, rays.origins)
        torch.testing.assert_close(same.pixel_radii, rays.pixel_radii)
        start += len(part)
    assert len(joined) == start


@pytest.mark.parametrize("model", ["pinhole", "opencv", "fisheye", "equirectangular"])
def test_one_model_stays(model: str) -> None:
    joined = join_cameras([cameras(model), cameras(model)])
    assert (joined.model, joined.lens, len(joined)) == (model, None, 4)


def test_fisheyes_with_and_without_coefficients() -> None:
    joined = join_cameras([cameras("fisheye"), cameras("fisheye", FISHEYE)])
    assert joined.lens is not None
    torch.testing.assert_close(joined.lens, torch.tensor([[0.0] * 4] * 2 + [FISHEYE] * 2))


@pytest.mark.parametrize(
    "models", [("fisheye", "opencv", "pinhole"), ("opencv", "orthographic"), ("equirectangular", "pinhole")]
)
def test_other_mixtures_are_refused_by_name(models: tuple[str, ...]) -> None:
    with pytest.raises(DataError, match=rf"different models \({', '.join(models)}\).*colmap image_undistorter"):
        join_cameras([cameras(model) for model in reversed(models)])
