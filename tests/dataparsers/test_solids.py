"""Solids with an exact surface: closed forms of volume and area, and rays against distances."""

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from nerfloom.data.dataset import load_dataset
from nerfloom.dataparsers.blender import Blender
from nerfloom.dataparsers.procedural.scene import Part
from nerfloom.dataparsers.procedural.shapes import BoredBox, Box, Shape, Sphere, Torus
from nerfloom.dataparsers.procedural.solids import DEVIATION, REFERENCE, SOLIDS, poses_around, surface, write_solids
from nerfloom.dataparsers.procedural.triangles import Triangles, of_bored_box, of_box, of_sphere, of_torus
from nerfloom.evaluation.surface_files import read_mesh

pytest.importorskip("trimesh")
FINE = 1e-4
BALL, BOX, RING, BORED = Sphere(0.5), Box((0.3, 0.2, 0.1)), Torus(0.4, 0.1), BoredBox((0.4, 0.3, 0.2), 0.15)
MADE = {
    "sphere": (BALL, of_sphere(BALL, FINE), 4 / 3 * math.pi * 0.5**3, math.pi),
    "box": (BOX, of_box(BOX), 0.6 * 0.4 * 0.2, 2 * (0.24 + 0.08 + 0.12)),
    "torus": (RING, of_torus(RING, FINE), 2 * math.pi**2 * 0.4 * 0.01, 4 * math.pi**2 * 0.04),
    "bored": (
        BORED,
        of_bored_box(BORED, FINE),
        0.8 * 0.6 * 0.4 - math.pi * 0.15**2 * 0.4,
        2 * (0.48 + 0.24 + 0.32) - 2 * math.pi * 0.15**2 + 2 * math.pi * 0.15 * 0.4,
    ),
}


def areas(made: Triangles) -> Tensor:
    a, b, c = made.vertices[made.faces].unbind(1)
    return torch.linalg.cross(b - a, c - a)


@pytest.mark.parametrize("name", MADE)
def test_triangles_are_on_the_surface_and_enclose_the_solid(name: str) -> None:
    shape, made, volume, area = MADE[name]
    assert float(shape.distance(made.vertices.T).abs().max()) < 1e-12
    inner = torch.cat([made.vertices[made.faces].mean(1), (made.vertices[made.faces[:, :2]]).mean(1)])
    assert float(shape.distance(inner.T.contiguous()).abs().max()) < FINE
    vectors = areas(made)
    found = float((made.vertices[made.faces[:, 0]] * vectors).sum()) / 6
    assert found == pytest.approx(volume, rel=2e-3)
    assert float(vectors.norm(dim=-1).sum()) / 2 == pytest.approx(area, rel=1e-3)
    # Outward, and by the faces' own normals but for the curvature within them.
    facing = (normalize(vectors, dim=-1)[:, None] * made.normals[made.faces]).sum(-1)
    assert float(facing.min()) > 0.98
    torch.testing.assert_close(made.normals.norm(dim=-1), torch.ones(len(made.normals)).double())


@pytest.mark.parametrize("name", MADE)
def test_normals_are_the_gradient_of_the_distance(name: str) -> None:
    shape, made, _, _ = MADE[name]
    middles = made.vertices[made.faces].mean(1)
    # Beside the surface, as the distance has an edge on it where two faces meet.
    points, step = (middles + 1e-4 * normalize(areas(made), dim=-1)).T, 1e-6
    columns = [shape.distance(points + step * e[:, None]) - shape.distance(points - step * e[:, None]) for e in unit()]
    gradient = torch.stack(columns) / (2 * step)
    torch.testing.assert_close(shape.normal(points), gradient, atol=2e-3, rtol=0)


def unit() -> Tensor:
    return torch.eye(3, dtype=torch.float64)


@pytest.mark.medium
@pytest.mark.parametrize("shape", [BOX, BORED, RING])
def test_rays_enter_where_the_distance_becomes_0(shape: Shape) -> None:
    """Sphere tracing, which trusts the distance alone, finds the same entries."""
    generator = torch.Generator().manual_seed(0)
    origins = 2 * normalize(torch.randn(4000, 3, generator=generator, dtype=torch.float64), dim=-1).T
    targets = 0.8 * torch.rand(3, 4000, generator=generator, dtype=torch.float64) - 0.4
    directions = normalize(targets - origins, dim=0)
    nearest = -(origins * directions).sum(0)
    offset = origins + nearest * directions
    entry = shape.enter(offset, directions, -nearest) + nearest
    t = torch.zeros_like(entry)
    for _ in range(600):
        t = t + shape.distance(origins + t * directions).clamp(min=0)
    hit = entry.isfinite()
    assert 0.2 < float(hit.double().mean()) < 0.9
    close = shape.distance(origins + t * directions) < 1e-6
    assert float((close == hit).double().mean()) > 0.998  # but for rays that graze
    both = close & hit
    assert float((t - entry)[both].abs().quantile(0.99)) < 1e-4
    assert float((t - entry)[both].abs().max()) < 0.02


def test_light_passes_through_a_hole() -> None:
    """A ray inside the hole meets its wall, and one along its axis nothing."""
    down = torch.tensor([[0.0, 0, -1]], dtype=torch.float64).T
    through = torch.tensor([[0.05, 0.05, 0.0]], dtype=torch.float64).T
    start = torch.tensor([-2.0], dtype=torch.float64)
    assert BORED.enter(through, down, start).tolist() == [math.inf]
    into = normalize(torch.tensor([[1.0, 0, -1]], dtype=torch.float64), dim=-1).T
    # Outwards from the middle of the hole, the wall is at x = 0.15.
    middle = torch.zeros(3, 1, dtype=torch.float64)
    assert float(BORED.enter(middle, into, torch.tensor([0.0]).double())) == pytest.approx(0.15 * 2**0.5)


def test_solids_touch_nothing_and_are_in_view() -> None:
    made = surface(1e-2)
    assert float(made.vertices.norm(dim=-1).max()) < 1.35
    for name, part in SOLIDS.items():
        others = [other for key, other in SOLIDS.items() if key != name]
        mine = signed_distance_of([part], made.vertices).abs() < 1e-9
        assert float(signed_distance_of(others, made.vertices[mine]).min()) > 0.03


def signed_distance_of(parts: list[Part], points: Tensor) -> Tensor:
    """The distance (N,) of points (N, 3) from the nearest of some solids."""
    found = []
    for part in parts:
        c, s = math.cos(part.yaw), math.sin(part.yaw)
        turn = torch.tensor([[c, s, 0], [-s, c, 0], [0, 0, 1]], dtype=torch.float64)
        centre = torch.tensor(part.centre, dtype=torch.float64)
        found.append(part.shape.distance(turn @ (points - centre).T))
    return torch.stack(found).amin(0)


def test_cameras_are_all_around() -> None:
    positions = torch.stack([torch.from_numpy(pose[:3, 3]) for pose in poses_around(100)])
    assert float(positions.mean(0).norm()) < 0.05 * 4
    assert float(torch.cdist(positions, positions).fill_diagonal_(9).amin(1).max()) < 1.5
    torch.testing.assert_close(positions.norm(dim=-1), torch.full((100,), 4.0).double())


@pytest.mark.slow
def test_a_data_set_is_written_and_read(tmp_path: Path) -> None:
    write_solids(tmp_path / "solids", size=32, num_train=6, num_test=2)
    parsed = Blender().parse(tmp_path / "solids", "train")
    dataset = load_dataset(parsed, "train")
    assert len(dataset) == 6
    assert dataset.scene.has_alpha
    torch.testing.assert_close(dataset.scene.box, torch.tensor([[-1.5] * 3, [1.5] * 3]))
    reference = read_mesh(tmp_path / "solids" / REFERENCE)
    assert reference.normals is not None
    # Projected into the images, vertices lie where these are not transparent.
    columns, rows, _ = dataset.cameras.project(reference.points[::50].float(), 0)
    alpha = dataset.image(0)[..., 3]
    assert float((alpha[rows.round().long(), columns.round().long()] > 0).float().mean()) > 0.97
    assert DEVIATION / reference.side < 1e-4
