"""Visible parts of a surface, against closed forms and rays."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras
from nerfloom.dataparsers.procedural.scene import trace_rows
from nerfloom.dataparsers.procedural.solids import SOLIDS, poses_around, surface
from nerfloom.dataparsers.procedural.views import CAMERA_ANGLE
from nerfloom.evaluation.surfaces import Surface, drawn
from nerfloom.evaluation.visibility import Shown, Sightings, count_sightings
from nerfloom.testing.ball import cameras_at
from tests.evaluation.surfaces import sphere, square, together

pytest.importorskip("trimesh")
COUNT, OCCLUDERS = 20_000, 200_000


def everything(index: int) -> Tensor | None:
    return None


def sighted(surface: Surface, cameras: Cameras, shown: Shown = everything) -> tuple[Tensor, Sightings]:
    """Points of a surface, and how many cameras see them."""
    points, occluders = drawn(surface, COUNT), drawn(surface, OCCLUDERS, seed=1)
    return points.positions, count_sightings(points, occluders, cameras, shown, "Looking")


def share(counts: Tensor, least: int = 1) -> float:
    return float((counts >= least).double().mean())


def around(distance: float, *signs: float, angle: float = 60.0, size: int = 400) -> Cameras:
    return cameras_at(torch.tensor([[sign * distance, 0.0, 0.0] for sign in signs]), angle, size)


@pytest.mark.medium
@pytest.mark.parametrize("distance", [2.0, 4.0, 20.0])
def test_a_camera_sees_its_cap_of_a_sphere(distance: float) -> None:
    """A camera at the distance D from a sphere of radius R sees the share (1 - R / D) / 2, except for the rim."""
    points, found = sighted(sphere(), around(distance, 1.0))
    rays = torch.nn.functional.normalize(points - torch.tensor([distance, 0, 0]), dim=-1)
    cosine = -(rays * points).sum(-1)  # between ray and normal
    assert share(found.seen) == pytest.approx((1 - 1 / distance) / 2, abs=0.02)
    assert float((found.seen[cosine > 0.2] > 0).double().mean()) > 0.999
    assert float((found.seen[cosine < -0.02] > 0).double().mean()) == 0


@pytest.mark.medium
@pytest.mark.parametrize("change", ["as it is", "inside out", "in disorder", "points without normals"])
def test_normals_may_point_anywhere(change: str) -> None:
    surface = sphere()
    assert surface.faces is not None
    faces = surface.faces.flip(-1) if change == "inside out" else surface.faces.clone()
    if change == "in disorder":
        faces[::2] = faces[::2].flip(-1)
    surface = replace(surface, faces=faces)
    if change == "points without normals":
        surface = Surface(drawn(surface, 300_000, seed=2).positions)
    _, found = sighted(surface, around(4.0, 1.0))
    # Without a side that is the back, a strip behind the horizon cannot be told from one before it.
    exact = change in ("as it is", "inside out")
    assert share(found.seen) == pytest.approx(0.375, abs=0.02 if exact else 0.05)


@pytest.mark.medium
def test_several_cameras() -> None:
    """Two on opposite sides see two caps; none of the points is seen by both."""
    _, found = sighted(sphere(), around(4.0, 1.0, -1.0))
    assert share(found.seen) == pytest.approx(0.75, abs=0.03)
    assert share(found.seen, least=2) == 0
    _, twice = sighted(sphere(), around(4.0, 1.0, 1.0))
    assert share(twice.seen, least=2) == pytest.approx(0.375, abs=0.02)


@pytest.mark.medium
def test_what_is_outside_of_the_image_or_masked_is_not_seen() -> None:
    """A camera at 10 has an image narrower than a square at 0: 1/4 is inside, and half of this is masked."""
    half, distance = 1.0, 10.0
    angle = 2 * math.degrees(math.atan(half / 2 / distance))
    cameras = cameras_at(torch.tensor([[0.0, 0.0, distance]]), angle, 200)
    mask = torch.zeros(200, 200, dtype=torch.bool)
    mask[:, :100] = True
    _, found = sighted(square(half=half), cameras, lambda index: mask)
    assert share(found.inside) == pytest.approx(1 / 4, abs=0.012)
    assert share(found.shown) == pytest.approx(1 / 8, abs=0.01)
    assert torch.equal(found.seen, found.shown)


@pytest.mark.medium
def test_what_is_behind_is_hidden() -> None:
    """A square half way to another throws a shadow of twice its size."""
    near, far = square(height=2.0, half=0.5), square(half=2.0)
    points, found = sighted(together(near, far), cameras_at(torch.tensor([[0.0, 0.0, 4.0]]), 80.0, 400))
    behind = points[:, 2] < 1
    assert share(found.seen[~behind]) == 1
    assert share(found.seen[behind]) == pytest.approx(3 / 4, abs=0.01)
    hidden = points[behind][:, :2].abs().amax(-1) < 1
    assert float(((found.seen[behind] == 0) == hidden).double().mean()) > 0.99


@pytest.mark.medium
def test_walls_within_walls_are_hidden_from_all_sides() -> None:
    """A sphere within another, its surface turned inwards, as in matter that is hollow: no camera sees it."""
    inner = sphere(0.9)
    assert inner.faces is not None
    hollow = together(sphere(), replace(inner, faces=inner.faces.flip(-1)))
    sides = torch.cat([torch.eye(3), -torch.eye(3)])
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3) / 3**0.5
    points, found = sighted(hollow, cameras_at(4 * torch.cat([sides, corners]), 40.0, 200))
    within = points.norm(dim=-1) < 0.95
    assert share(found.seen[within]) < 0.001
    assert share(found.seen[~within]) > 0.99


@pytest.mark.medium
def test_cameras_of_every_model_see_the_same_cap() -> None:
    made = around(4.0, 1.0)
    fisheye = replace(made, model="fisheye", fx=made.fx / 2, fy=made.fy / 2)
    lens = torch.tensor([[0.05, 0, 0, 0, 0, 0, 0, 0, 0]])
    for cameras in (replace(made, model="opencv", lens=lens), fisheye):
        _, found = sighted(sphere(), cameras)
        assert share(found.seen) == pytest.approx(0.375, abs=0.02)
    parallel = replace(made, model="orthographic", fx=made.fx / 4, fy=made.fy / 4)
    assert share(sighted(sphere(), parallel)[1].seen) == pytest.approx(0.5, abs=0.03)


@pytest.mark.slow
def test_solids_as_rays_see_them() -> None:
    """Occlusion among solids, with thin parts and a hole, from 12 sides, camera by camera."""
    vertices, normals, faces = surface()
    reference = Surface(vertices, faces, normals)
    poses = torch.stack([torch.from_numpy(pose)[:3].float() for pose in poses_around(12)])
    focal = torch.full((12,), 200 / math.tan(CAMERA_ANGLE / 2))
    middle, sizes = torch.full((12,), 200.0), torch.full((12,), 400)
    cameras = Cameras(poses, focal, focal, middle, middle, sizes, sizes)
    points = drawn(reference, 4000)
    occluders = drawn(reference, 1_000_000, seed=1)
    assert points.normals is not None
    missed, extra = [], []
    for index in range(12):
        camera = cameras[index : index + 1]
        found = count_sightings(points, occluders, camera, everything, "Looking").seen > 0
        # A ray from the camera that first meets the scene at the point.
        eye = camera.camera_to_worlds[0, :, 3].double()
        towards = points.positions - eye
        length = towards.norm(dim=-1)
        directions = (towards / length[:, None]).T.contiguous()
        seen = trace_rows(eye[:, None], directions, 0.0, colour=False, parts=SOLIDS).depth > length - 1e-3
        steep = -(directions.T * points.normals).sum(-1) < 0.3
        missed.append(float((seen & ~found & ~steep).double().mean()))
        extra.append(float((found & ~seen).double().mean()))
    assert max(missed) < 0.01
    assert max(extra) < 0.01
