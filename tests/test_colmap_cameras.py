"""COLMAP's camera models: our rays, projected by COLMAP itself."""

from typing import Any

import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.colmap import PARAMETERS, from_colmap
from nerfloom.data.coverage import unreachable_pixels

WIDTH, HEIGHT = 1600, 1064
REAL: dict[str, list[float]] = {
    "SIMPLE_PINHOLE": [1234.5, 801.25, 530.5],
    "PINHOLE": [1234.5, 1230.25, 801.25, 530.5],
    "SIMPLE_RADIAL": [1234.5, 801.25, 530.5, -0.08],
    "RADIAL": [1100.0, 801.25, 530.5, -0.21, 0.06],
    "OPENCV": [1050.0, 1047.5, 790.75, 541.5, -0.28, 0.09, 6e-4, -9e-4],
    "FULL_OPENCV": [900.0, 905.0, 790.75, 541.5, 0.7, -0.12, 5e-4, -4e-4, 0.01, 1.0, 0.05, -0.01],
    "SIMPLE_RADIAL_FISHEYE": [720.0, 801.25, 530.5, -0.03],
    "RADIAL_FISHEYE": [720.0, 801.25, 530.5, -0.03, 4e-3],
    "OPENCV_FISHEYE": [720.0, 722.0, 790.75, 541.5, 0.04, -0.01, 3e-3, -6e-4],
}
"""Parameters such as reconstructions end with. The fisheyes' corners are 75 degrees off the axis."""


def camera_of(name: str, params: list[float], dtype: torch.dtype = torch.float32) -> Cameras:
    model, fx, fy, cx, cy, lens = from_colmap(name, params, WIDTH, HEIGHT)
    return Cameras(
        torch.eye(4)[None, :3].to(dtype),
        *(torch.tensor([value], dtype=dtype) for value in (fx, fy, cx, cy)),
        torch.tensor([WIDTH]),
        torch.tensor([HEIGHT]),
        model,
        torch.tensor([lens], dtype=dtype) if lens else None,
    )


def by_colmap(name: str, params: list[float], directions: torch.Tensor) -> torch.Tensor:
    """Where COLMAP sees directions (R, 3) of our frame: columns and rows (R, 2) from the image's corner."""
    pycolmap: Any = pytest.importorskip("pycolmap")
    camera = pycolmap.Camera(model=name, width=WIDTH, height=HEIGHT, params=params)
    local = (directions.double() * torch.tensor([1.0, -1.0, -1.0])).numpy()  # its y is down, its z ahead
    try:
        return torch.as_tensor(camera.img_from_cam(local))
    except TypeError:  # up to 3.10: points of the plane at depth 1, one by one or together
        return torch.as_tensor(camera.img_from_cam(local[:, :2] / local[:, 2:]))


def pixels(step: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Columns and rows all over the image, the last ones too."""
    columns = torch.cat([torch.arange(0, WIDTH - 1, step), torch.tensor([WIDTH - 1])])
    rows = torch.cat([torch.arange(0, HEIGHT - 1, step), torch.tensor([HEIGHT - 1])])
    return torch.meshgrid(columns, rows, indexing="xy")


def test_every_model_is_tested() -> None:
    assert REAL.keys() == PARAMETERS.keys()


@pytest.mark.parametrize("name", PARAMETERS)
def test_colmap_sees_our_rays_where_they_start(name: str) -> None:
    """float32 rays by the path that training takes (compiled, where there are kernels), and float64 ones."""
    columns, rows = (values.reshape(-1) for values in pixels(7))
    camera = camera_of(name, REAL[name])
    flat = rows * WIDTH + columns
    exact = camera_of(name, REAL[name], torch.float64).rays(torch.zeros_like(columns), columns.double(), rows, 0, 1)
    truth = torch.stack([columns, rows], dim=-1) + 0.5
    for what, rays, limit in (
        ("float32", camera.pixel_rays(flat, 0, 1), 1e-3),
        ("float32, torch", camera.pixel_rays_reference(flat, 0, 1), 1e-3),
        ("float64", exact, 1e-5),
    ):
        error = (by_colmap(name, REAL[name], rays.directions) - truth).abs().max().item()
        print(f"{name}, {what}: back within {error:.1e} pixels")
        assert error < limit
    assert len(unreachable_pixels(camera)) == 0


@pytest.mark.parametrize("name", PARAMETERS)
def test_we_project_as_colmap_does(name: str) -> None:
    directions = torch.randn(500, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    directions = torch.nn.functional.normalize(directions * 0.4 - torch.tensor([0.0, 0.0, 1.0]), dim=-1)
    columns, rows, in_front = camera_of(name, REAL[name], torch.float64).project(directions * 3, 0)
    theirs = by_colmap(name, REAL[name], directions)
    found = torch.stack([columns, rows], dim=-1) + 0.5
    in_front &= directions[:, 2] < 0  # COLMAP's fisheyes end at 90 degrees
    assert in_front.sum() > 250
    torch.testing.assert_close(found[in_front], theirs[in_front], rtol=1e-12, atol=1e-8)


def test_no_distortion_is_a_pinhole() -> None:
    assert from_colmap("SIMPLE_RADIAL", [500, 320, 240, 0], 640, 480) == ("pinhole", 500, 500, 320, 240, ())
    assert from_colmap("OPENCV_FISHEYE", [500, 501, 320, 240, 0, 0, 0, 0], 640, 480).model == "fisheye"


@pytest.mark.parametrize("name", ["FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE", "EUCM", "nonsense"])
def test_other_models_are_refused_by_name(name: str) -> None:
    with pytest.raises(DataError, match=f"{name} is not supported.*colmap image_undistorter"):
        from_colmap(name, [1.0] * 12, 640, 480)


@pytest.mark.parametrize(
    ("params", "words"),
    [
        ([500.0, 320.0, 240.0], "4 parameters"),
        ([0.0, 500.0, 320.0, 240.0], "fx=0"),
        ([500.0, float("nan"), 320.0, 240.0], "fy=nan"),
    ],
)
def test_impossible_cameras_are_refused(params: list[float], words: str) -> None:
    with pytest.raises(DataError, match=f"PINHOLE.*{words}"):
        from_colmap("PINHOLE", params, 640, 480)


@pytest.mark.parametrize("size", [(0, 480), (640, 2**64 - 1)])
def test_impossible_sizes_are_refused(size: tuple[int, int]) -> None:
    with pytest.raises(DataError, match=f"is invalid: {size[0]}x{size[1]} pixels"):
        from_colmap("PINHOLE", [500.0, 500.0, 320.0, 240.0], *size)
