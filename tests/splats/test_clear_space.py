"""Space right before cameras: its size, what lies in it, and what becomes of Gaussians there."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from nerfloom.cameras.cameras import Cameras
from nerfloom.dataparsers.procedural.courtyard import COURTYARD, courtyard_poses
from nerfloom.dataparsers.procedural.views import CAMERA_ANGLE, visible_parts
from nerfloom.methods.gaussian_splatting import METHOD, GaussianSplatting, GaussianSplattingConfig
from nerfloom.splats.clear_space import CLEAR, NEAREST, clear_radii, in_clear_space
from nerfloom.splats.start import from_points
from tests.splats.test_method import SCENE

SIDE = 20


def test_the_radius_of_a_camera_is_a_share_of_its_near_distances() -> None:
    """Cameras with 200 distances, with none, and with one."""
    torch.manual_seed(0)
    order = torch.randperm(201)
    distances = torch.cat([torch.arange(1.0, 201.0), torch.tensor([7.0])])[order]
    images = torch.tensor([0] * 200 + [2])[order]
    expected = CLEAR * torch.tensor([1 + 200 * NEAREST, 0.0, 7.0])
    torch.testing.assert_close(clear_radii(images, distances, 3), expected)
    nothing = clear_radii(images[:0], distances[:0], 3)
    assert torch.equal(nothing, torch.zeros(3))
    assert not bool(in_clear_space(torch.zeros(5, 3), torch.eye(3, 4).repeat(3, 1, 1), nothing).any())


def test_clear_space_is_a_half_ball_before_each_camera() -> None:
    """Point by point in float64."""
    torch.manual_seed(1)
    poses, radii = torch.zeros(12, 3, 4), torch.rand(12)
    poses[:, :, :3] = torch.linalg.qr(torch.randn(12, 3, 3)).Q
    poses[:, :, 3] = torch.randn(12, 3)
    radii[3] = 0
    points = torch.randn(3_000, 3)
    truth = []
    for point in points.double().numpy():
        away = point - poses[:, :, 3].double().numpy()
        before = -(away * poses[:, :, 2].double().numpy()).sum(-1) > 0
        truth.append(bool((before & (np.linalg.norm(away, axis=-1) < radii.double().numpy())).any()))
    assert 100 < sum(truth) < 2_000
    assert in_clear_space(points, poses, radii).tolist() == truth


def test_nothing_that_photographs_of_the_courtyard_show_is_in_clear_space() -> None:
    """All true surfaces, from 24 cameras; the middle of each camera's space is clear."""
    poses = torch.stack([torch.from_numpy(pose[:3]) for pose in courtyard_poses("train", 24, 0)]).float()
    depths = [visible_parts(pose.double().numpy(), (SIDE, SIDE), COURTYARD)[0].ravel() for pose in poses]
    focal = torch.full((24,), SIDE / 2 / math.tan(CAMERA_ANGLE / 2))
    middle, size = torch.full((24,), SIDE / 2), torch.full((24,), SIDE)
    cameras = Cameras(poses, focal, focal, middle, middle, size, size, "pinhole")
    rays = cameras.pixel_rays(torch.arange(24 * SIDE * SIDE), 0.0, 1.0)
    distances = torch.from_numpy(np.concatenate(depths)).float()
    surfaces = rays.origins + distances[:, None] * rays.directions
    radii = clear_radii(torch.arange(24).repeat_interleave(SIDE * SIDE), distances, 24)
    assert float(radii.min()) > 0.5
    assert not bool(in_clear_space(surfaces, poses, radii).any())
    assert bool(in_clear_space(poses[:, :, 3] - 0.3 * poses[:, :, 2], poses, radii).all())


@pytest.mark.parametrize("strategy", ["adc", "mcmc", "relocation"])
@pytest.mark.parametrize(("closed", "known"), [(True, True), (True, False), (False, True)])
def test_gaussians_before_a_camera_go_if_every_ray_ends_in_the_box(strategy: str, closed: bool, known: bool) -> None:
    """A camera in the middle looks along -z at things 2 units away. In other scenes nothing changes."""
    pose = torch.eye(3, 4)[None]
    scene = dataclasses.replace(SCENE, num_cameras=1, camera_to_worlds=pose, has_alpha=not closed)
    asked = GaussianSplattingConfig(num_gaussians=3, start_gaussians=3, degree=0, strategy=strategy)  # type: ignore[arg-type]
    model = GaussianSplatting(METHOD.decided(asked, scene)[0], scene)
    places = torch.tensor([[0.0, 0.0, -0.3], [0.0, 0.0, 0.3], [0.0, 0.0, -1.0]])
    model.set_gaussians(from_points(places, torch.rand(3, 3), 0, opacity=0.5))
    if known:
        model.found_distances.set(torch.zeros(9, dtype=torch.long), torch.arange(9), torch.full((9,), 2.0))
    changes = model.after_step(0, 0.0)
    if not (closed and known):
        assert len(changes) == 0
        return
    means = next(change for change in changes if change.parameter is model.columns["means"].values)
    assert means.fresh is not None
    left = torch.cat([means.parameter.detach()[means.kept], means.fresh]) * model.extent
    assert len(left) == (2 if strategy == "adc" else 3)
    assert float((left - places[0]).norm(dim=-1).min()) > 0.1
