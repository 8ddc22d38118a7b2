"""Points on triangles, against closed forms and trimesh."""

import numpy as np
import pytest
import torch
from scipy.stats import chisquare
from torch import Tensor

from nerfloom.geometry.triangles import area_vectors, draw_on_triangles, nearest_on_triangles

trimesh = pytest.importorskip("trimesh")


def random_triangles(count: int, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)


def test_area_vectors_point_to_where_corners_are_counterclockwise() -> None:
    corners = torch.tensor([[[0.0, 0, 0], [3, 0, 0], [0, 2, 0]]], dtype=torch.float64)
    assert area_vectors(corners).tolist() == [[0, 0, 6]]


def test_nearest_points_are_trimeshs() -> None:
    corners = random_triangles(5000)
    corners[::3, 2] = corners[::3, 0] + 1e-5 * corners[::3, 2]  # slivers
    points = 2 * random_triangles(5000, seed=1)[:, 0]
    weights, distances = nearest_on_triangles(points, corners)
    theirs = trimesh.triangles.closest_point(corners.numpy(), points.numpy())
    ours = (weights[:, None] @ corners)[:, 0].numpy()
    np.testing.assert_allclose(ours, theirs, atol=1e-7)
    np.testing.assert_allclose(distances.numpy(), np.linalg.norm(points.numpy() - theirs, axis=-1), atol=1e-12)
    assert bool((weights >= 0).all())
    torch.testing.assert_close(weights.sum(-1), torch.ones(5000, dtype=torch.float64))


def test_a_triangle_without_area_is_a_line_or_a_point() -> None:
    line = torch.tensor([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0]], [[1.0, 1, 1]] * 3], dtype=torch.float64)
    points = torch.tensor([[1.5, 1, 0], [1, 1, 3]], dtype=torch.float64)
    weights, distances = nearest_on_triangles(points, line)
    assert distances.tolist() == [1, 2]
    assert (weights[:, None] @ line)[:, 0].tolist() == [[1.5, 0, 0], [1, 1, 1]]


def test_points_are_even_by_area_however_unequal_the_triangles() -> None:
    corners = random_triangles(200) * torch.logspace(-3, 1, 200, dtype=torch.float64)[:, None, None]
    areas = area_vectors(corners).norm(dim=-1)
    faces, _ = draw_on_triangles(corners, 100_000)
    counts = torch.bincount(faces, minlength=200)
    assert float((counts - 100_000 * areas / areas.sum()).abs().max()) < 2


def test_points_are_even_within_a_triangle() -> None:
    """If a triangle is divided into 64 similar ones, each holds as many points as chance allows."""
    corners = random_triangles(1)
    _, weights = draw_on_triangles(corners, 200_000)
    cells = (8 * weights).floor().long().clamp(max=7)
    _, counts = torch.unique(cells @ torch.tensor([64, 8, 1]), return_counts=True)
    assert len(counts) == 64
    assert chisquare(counts.numpy()).pvalue > 1e-4
    # The mean of w_i w_j over a triangle is 1/6 for i = j and 1/12 otherwise.
    found = weights.T @ weights / len(weights)
    torch.testing.assert_close(found, (torch.ones(3, 3) + torch.eye(3)).double() / 12, atol=1e-3, rtol=0)


def test_the_same_seed_draws_the_same_points() -> None:
    corners = random_triangles(20)
    one, same, other = (draw_on_triangles(corners, 1000, seed) for seed in (3, 3, 4))
    assert torch.equal(one[0], same[0])
    assert torch.equal(one[1], same[1])
    assert not torch.equal(one[1], other[1])
