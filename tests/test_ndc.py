"""Normalised device coordinates: the rays of a photograph's pixels, as OpenGL's projection matrix maps the scene."""

import dataclasses

import numpy as np
import pytest
import torch

from nerfloom import Cameras
from nerfloom.base.errors import DataError
from nerfloom.cameras.ndc import Ndc, NdcCameras, find_ndc, middle_frame, ndc_box

NEARS = torch.full((5,), 2.0, dtype=torch.float64)


def turned(yaw: float, pitch: float, place: list[float]) -> torch.Tensor:
    """(3, 4) pose of a camera turned away from -z by small angles."""
    a, b = np.cos([yaw, pitch]), np.sin([yaw, pitch])
    yawed = np.array([[a[0], 0, b[0]], [0, 1, 0], [-b[0], 0, a[0]]])
    pitched = np.array([[1, 0, 0], [0, a[1], -b[1]], [0, b[1], a[1]]])
    return torch.from_numpy(np.column_stack([yawed @ pitched, place]))


@pytest.fixture
def plain() -> Cameras:
    places = [[0.0, 0, 0], [0.5, 0.2, 0.1], [-0.6, 0.1, -0.1], [0.1, -0.4, 0.2], [0, 0.3, -0.2]]
    angles = [(0.0, 0.0), (0.1, -0.05), (-0.12, 0.03), (0.02, 0.1), (0.0, -0.1)]
    poses = torch.stack([turned(*angle, place) for angle, place in zip(angles, places, strict=True)]).float()
    ones = torch.ones(5)
    whole = torch.ones(5, dtype=torch.int64)
    return Cameras(poses, 40 * ones, 40 * ones, 12 * ones, 8 * ones, 24 * whole, 16 * whole)


def corners(cameras: Cameras) -> torch.Tensor:
    x = torch.tensor([-12.0, 12, -12, 12]) / 40
    y = torch.tensor([8.0, 8, -8, -8]) / 40
    local = torch.stack([x, y, -torch.ones(4)], -1).double()
    return local @ cameras.camera_to_worlds[:, :, :3].double().transpose(1, 2)


@pytest.fixture
def bent(plain: Cameras) -> NdcCameras:
    ndc = find_ndc(plain.camera_to_worlds.double(), corners(plain), NEARS)
    known = {field.name: getattr(plain, field.name) for field in dataclasses.fields(plain)}
    return NdcCameras(**known, ndc=ndc)


def projected(ndc: Ndc, points: np.ndarray) -> np.ndarray:
    """OpenGL's matrix for a pyramid from `near` to almost infinity, in homogeneous coordinates."""
    far, near = 1e12, ndc.near
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[1, 1] = 1 / ndc.half_width, 1 / ndc.half_height
    matrix[2, 2:] = -(far + near) / (far - near), -2 * far * near / (far - near)
    matrix[3, 2] = -1
    frame = np.array(ndc.frame)
    local = points @ frame[:, :3].T + frame[:, 3]
    clip = np.column_stack([local, np.ones(len(local))]) @ matrix.T
    return clip[:, :3] / clip[:, 3:]


def test_rays_are_where_the_projection_matrix_puts_their_points(plain: Cameras, bent: NdcCameras) -> None:
    assert bent.ndc is not None
    everything = torch.arange(5 * 24 * 16)
    before = plain.pixel_rays_reference(everything, 0.0, 100.0)
    after = bent.pixel_rays(everything, 0.0, 100.0)
    last = torch.zeros(len(everything))
    for distance in (2.5, 4.0, 30.0, 1e4):
        points = before.origins.double() + distance * before.directions.double()
        expected = torch.from_numpy(projected(bent.ndc, points.numpy())).float()
        t = ((expected - after.origins) * after.directions).sum(-1)
        torch.testing.assert_close(after.origins + t[:, None] * after.directions, expected, atol=2e-5, rtol=0)
        assert bool((t > last).all())
        assert bool((t <= after.fars + 1e-5).all())
        last = t
    torch.testing.assert_close(after.directions.norm(dim=-1), torch.ones(len(everything)))
    torch.testing.assert_close(after.origins[:, 2], -torch.ones(len(everything)))
    ends = after.origins + after.fars[:, None] * after.directions
    torch.testing.assert_close(ends[:, 2], torch.ones(len(everything)))
    assert torch.equal(after.camera_indices, before.camera_indices)


def test_the_box_holds_all_rays_and_no_more_than_a_pixel_besides(plain: Cameras, bent: NdcCameras) -> None:
    assert bent.ndc is not None
    box = ndc_box(bent.ndc, plain.camera_to_worlds.double(), corners(plain)).float()
    rays = bent.pixel_rays(torch.arange(5 * 24 * 16), 0.0, 100.0)
    ends = torch.cat([rays.origins, rays.origins + rays.fars[:, None] * rays.directions])
    assert bool((ends >= box[0] - 1e-5).all())
    assert bool((ends <= box[1] + 1e-5).all())
    torch.testing.assert_close(torch.stack([ends.amin(0), ends.amax(0)]), box, atol=0.1, rtol=0)


def test_a_pixels_width_is_the_cones_half_way(bent: NdcCameras) -> None:
    """Mip-NeRF's radius is 2 / sqrt(12) of a pixel."""
    rays = bent.rays(torch.tensor([0, 0]), torch.tensor([11.0, 12.0]), torch.tensor([7.5, 7.5]), 0.0, 100.0)
    middle = rays.origins + rays.fars[:, None] / 2 * rays.directions
    width = float((middle[1] - middle[0]).norm())
    assert rays.pixel_radii is not None
    assert float(rays.pixel_radii[0] * rays.fars[0] / 2) == pytest.approx(2 / 12**0.5 * width, rel=0.05)


def test_choosing_moving_and_resizing_keep_the_coordinates(bent: NdcCameras) -> None:
    for cameras in (bent[torch.tensor([3])], bent.to("cpu"), bent.scaled(0.5)):
        assert isinstance(cameras, NdcCameras)
        assert cameras.ndc == bent.ndc


def test_a_ray_that_looks_elsewhere_has_no_length(bent: NdcCameras) -> None:
    aside = dataclasses.replace(bent, camera_to_worlds=torch.stack([turned(2.0, 0.0, [0.0, 0, 0])] * 5).float())
    rays = aside.rays(torch.tensor([0]), torch.tensor([3.0]), torch.tensor([3.0]), 0.1, 100.0)
    assert rays.nears.tolist() == rays.fars.tolist() == [0]
    assert bool(rays.directions.isfinite().all())


def test_the_middle_frame_is_a_camera(plain: Cameras) -> None:
    frame = middle_frame(plain.camera_to_worlds)
    torch.testing.assert_close(frame[:, :3] @ frame[:, :3].T, torch.eye(3), atol=1e-6, rtol=0)
    assert torch.linalg.det(frame[:, :3]).item() == pytest.approx(1)
    torch.testing.assert_close(frame @ torch.tensor([*plain.camera_to_worlds[:, :, 3].mean(0), 1.0]), torch.zeros(3))


def test_cameras_that_look_elsewhere_are_refused(plain: Cameras) -> None:
    poses = plain.camera_to_worlds.clone()
    poses[0] = turned(2.5, 0.0, [0.0, 0, 0]).float()
    around = dataclasses.replace(plain, camera_to_worlds=poses)
    with pytest.raises(DataError, match="look the same way"):
        find_ndc(poses.double(), corners(around), NEARS)
    with pytest.raises(DataError, match="look the same way"):
        find_ndc(plain.camera_to_worlds.double(), corners(plain), 0.05 * NEARS)
