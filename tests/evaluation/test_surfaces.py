"""Surfaces: their usable parts, and distances to them against all of their faces."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from nerfloom.base.errors import DataError
from nerfloom.evaluation.surfaces import Surface, drawn, nearest, point_spacing, usable
from tests.evaluation.surfaces import sphere, square, tensor, together

trimesh = pytest.importorskip("trimesh")


def test_faces_that_cannot_be_used_are_left_out_and_counted() -> None:
    good = square()
    assert good.faces is not None
    points = torch.cat([good.points, torch.tensor([[torch.nan, 0, 0], [torch.inf, 0, 0]], dtype=torch.float64)])
    faces = torch.cat([good.faces, torch.tensor([[0, 1, 4], [0, 1, 5], [2, 2, 3], [0, 0, 0]])])
    found, notes = usable(Surface(points, faces), "it")
    assert found.faces is not None
    assert found.faces.tolist() == good.faces.tolist()
    assert notes == ["2 points with coordinates that are not finite", "2 faces without a finite area"]
    assert found.side == 1
    assert bool(drawn(found, 100).positions.isfinite().all())


@pytest.mark.parametrize(
    ("surface", "reason"),
    [
        (Surface(torch.zeros(0, 3).double(), torch.zeros(0, 3).long()), "no face with an area"),
        (Surface(torch.full((3, 3), torch.nan).double(), torch.tensor([[0, 1, 2]])), "no face with an area"),
        (Surface(1e300 * torch.eye(3, dtype=torch.float64), torch.tensor([[0, 1, 2]])), "no face with an area"),
        (Surface(1e308 * torch.tensor([[1.0, 0, 0], [-1, 0, 0]], dtype=torch.float64)), "no two points"),
        (Surface(torch.zeros(0, 3).double()), "no two points"),
        (Surface(torch.ones(5, 3).double()), "no two points"),
    ],
)
def test_nothing_usable_is_refused(surface: Surface, reason: str) -> None:
    with pytest.raises(DataError, match=reason):
        usable(surface, "it")


def test_normals_that_are_no_normals_are_not_used() -> None:
    flat = square()
    doubled, notes = usable(replace(flat, normals=torch.tensor([[0, 0, 2.0]] * 4).double()), "it")
    assert notes == []
    assert doubled.normals is not None
    assert doubled.normals.tolist() == [[0, 0, 1]] * 4
    zero, notes = usable(replace(flat, normals=torch.zeros(4, 3).double()), "it")
    assert zero.normals is None
    assert notes == ["all normals, as some are zero or not finite"]


@pytest.mark.medium
def test_distances_are_those_to_the_nearest_of_all_faces() -> None:
    surface = sphere(0.7, level=2)
    assert surface.faces is not None
    generator = torch.Generator().manual_seed(0)
    points = 2 * torch.rand(500, 3, generator=generator, dtype=torch.float64) - 1
    corners = surface.corners.numpy()
    of_all = np.stack([trimesh.triangles.closest_point(corners, np.tile(p, (len(corners), 1))) for p in points.numpy()])
    expected = np.linalg.norm(of_all - points.numpy()[:, None], axis=-1).min(1)
    found, normals = nearest(points, surface)
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-9)
    assert normals is not None
    # The normal of a face of the sphere is about along the radius.
    radial = torch.nn.functional.normalize(points, dim=-1)
    assert float((normals * radial).sum(-1).min()) > 0.95


def test_small_faces_are_found_beside_a_large_one() -> None:
    """Two faces have 10^-8 of the area, and no point is drawn on them."""
    surface = together(square(half=100.0), square(height=1.0, half=0.01))
    found, _ = nearest(torch.tensor([[0, 0, 1.5], [50, 50, 1.5]], dtype=torch.float64), surface)
    assert found.tolist() == pytest.approx([0.5, 1.5])


def test_normals_at_vertices_are_interpolated() -> None:
    surface = sphere(1.0, level=2)
    smooth = replace(surface, normals=torch.nn.functional.normalize(surface.points, dim=-1))

    def worst(samples_of: Surface) -> float:
        samples = drawn(samples_of, 2000)
        assert samples.normals is not None
        return float((samples.normals - torch.nn.functional.normalize(samples.positions, dim=-1)).norm(dim=-1).max())

    assert worst(smooth) < 0.01 < 0.1 < worst(surface)


def test_the_spacing_of_points() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.cat([torch.rand(20_000, 2, generator=generator), torch.zeros(20_000, 1)], -1).double()
    assert point_spacing(points) == pytest.approx(20_000**-0.5, rel=0.1)
    fewer = drawn(Surface(points), 5000)
    assert len(fewer.positions) == 5000
    assert fewer.spacing == pytest.approx(5000**-0.5, rel=0.1)
    assert drawn(square(), 100).spacing == pytest.approx(0.1)


def test_points_given_as_points() -> None:
    points = Surface(tensor(np.array([[0.0, 0, 0], [3, 0, 0]])), None, tensor(np.array([[0.0, 0, 1], [0, 1, 0]])))
    found, normals = nearest(torch.tensor([[1.0, 0, 0], [3, 4, 0]], dtype=torch.float64), points)
    assert found.tolist() == [1, 4]
    assert normals is not None
    assert normals.tolist() == [[0, 0, 1], [0, 1, 0]]
    assert math.isclose(points.side, 3)
