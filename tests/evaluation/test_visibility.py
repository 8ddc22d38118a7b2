"""What cameras see of a surface, against closed forms and rays."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras
from nerfloom.dataparsers.procedural.scene import trace_rows
from nerfloom.dataparsers.procedural.solids import SOLIDS, poses_around, surface
from nerfloom.dataparsers.procedural.views import CAMERA_ANGLE
from nerfloom.evaluation.surfaces import DENSE, Surface, drawn
from nerfloom.evaluation.visibility import Shown, Sightings, count_sightings
from nerfloom.testing.ball import cameras_at
from tests.evaluation.surfaces import sphere, square, together

pytest.importorskip("trimesh")
COUNT = 20_000


def everything(index: int) -> Tensor | None:
    return None


def sighted(surface: Surface, cameras: Cameras, shown: Shown = everything) -> tuple[Tensor, Sightings]:
    """Points of a surface, and how many cameras see them."""
    points, occluders = drawn(surface, COUNT), drawn(surface, DENSE, seed=1)
    return points.positions, count_sightings(points, occluders, cameras, shown, "Looking")


def share(counts: Tensor, least: int = 1) -> float:
    return float((counts >= least).double().mean())


def around(distance: float, *signs: float, angle: float = 60.0, size: int = 400) -> Cameras:
    return cameras_at(torch.tensor([[sign * distance, 0.0, 0.0] for sign in signs]), angle, size)


@pytest.mark.medium
def test_a_camera_sees_its_cap_of_a_sphere() -> None:
    """From a distance D of a sphere of radius R, the share (1 - R / D) / 2."""
    for distance in (2.0, 4.0, 20.0):
        points, found = sighted(sphere(), around(distance, 1.0))
        assert share(found.seen) == pytest.approx((1 - 1 / distance) / 2, abs=0.003)
        seen = points[:, 0] > 1 / distance
        assert float(((found.seen > 0) == seen).double().mean()) > 0.99


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
    assert share(found.seen) == pytest.approx(0.375, abs=0.003 if exact else 0.05)


@pytest.mark.medium
def test_several_cameras() -> None:
    """Two on opposite sides see two caps; none of the points is seen by both."""
    _, found = sighted(sphere(), around(4.0, 1.0, -1.0))
    assert share(found.seen) == pytest.approx(0.75, abs=0.005)
    assert share(found.seen, least=2) == 0
    _, twice = sighted(sphere(), around(4.0, 1.0, 1.0))
    assert share(twice.seen, least=2) == pytest.approx(0.375, abs=0.003)


@pytest.mark.medium
def test_what_is_outside_of_the_image_or_masked_is_not_seen() -> None:
    """A camera at 10 whose image is narrower than a square at 0: 1/4 is inside, and of this half is masked."""
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
def test_cameras_of_every_model_see_the_same_cap() -> None:
    made = around(4.0, 1.0)
    fisheye = replace(made, model="fisheye", fx=made.fx / 2, fy=made.fy / 2)
    lens = torch.tensor([[0.05, 0, 0, 0, 0, 0, 0, 0, 0]])
    for cameras in (replace(made, model="opencv", lens=lens), fisheye):
        _, found = sighted(sphere(), cameras)
        assert share(found.seen) == pytest.approx(0.375, abs=0.004)
    parallel = replace(made, model="orthographic", fx=made.fx / 4, fy=made.fy / 4)
    assert share(sighted(sphere(), parallel)[1].seen) == pytest.approx(0.5, abs=0.005)


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
    occluders = drawn(reference, DENSE, seed=1)
    assert points.normals is not None
    wrong = []
    for index in range(12):
        camera = cameras[index : index + 1]
        found = count_sightings(points, occluders, camera, everything, "Looking").seen > 0
        # A ray from the camera that first meets the scene at the point.
        eye = camera.camera_to_worlds[0, :, 3].double()
        towards = points.positions - eye
        length = towards.norm(dim=-1)
        hit = trace_rows(eye[:, None], (towards / length[:, None]).T.contiguous(), 0.0, colour=False, parts=SOLIDS)
        seen = hit.depth > length - 1e-3
        wrong.append(float((found != seen).double().mean()))
    assert max(wrong) < 0.03
    assert sum(wrong) / 12 < 0.015
