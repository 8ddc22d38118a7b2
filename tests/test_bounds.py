"""Boxes and contraction against brute force and closed forms."""

import pytest
import torch

from nerfloom.geometry.bounds import contract, intersect_box, to_unit_box

BOX = torch.tensor([[-1.0, -2.0, 0.0], [1.0, 1.0, 3.0]], dtype=torch.float64)


@pytest.mark.medium
def test_random_rays_against_dense_points() -> None:
    generator = torch.Generator().manual_seed(0)
    origins = torch.randn(500, 3, generator=generator, dtype=torch.float64) * 2
    directions = torch.randn(500, 3, generator=generator, dtype=torch.float64)
    directions /= directions.norm(dim=-1, keepdim=True)
    enter, leave = intersect_box(origins, directions, BOX)
    t = torch.linspace(0, 20, 20001, dtype=torch.float64)
    points = origins[:, None] + t[:, None] * directions[:, None]
    inside = ((points >= BOX[0]) & (points <= BOX[1])).all(-1)
    hits = inside.any(-1)
    first = torch.where(hits, t[inside.int().argmax(-1)], torch.zeros(()).double())
    last = torch.where(hits, t[20000 - inside.flip(-1).int().argmax(-1)], torch.zeros(()).double())
    grazing = ~hits & (leave - enter < 2e-3)
    assert bool((((enter - first).abs() < 2e-3) | grazing).all())
    assert bool((((leave - last).abs() < 2e-3) | grazing).all())
    assert 50 < int(hits.sum()) < 450


@pytest.mark.parametrize(
    ("origin", "direction", "expected"),
    [
        ((0, 0, -5), (0, 0, 1), (5, 8)),  # parallel to four faces, through the middle
        ((2, 0, -5), (0, 0, 1), (0, 0)),  # parallel, outside a slab
        ((1, 0, -5), (0, 0, 1), (5, 8)),  # parallel, on a face
        ((0, 0, 1), (0, 0, 1), (0, 2)),  # starts inside
        ((0, 0, 3), (0, 0, 1), (0, 0)),  # on the face it leaves by
        ((0, 0, 0), (0, 0, 1), (0, 3)),  # on the face it enters by
        ((0, 0, 5), (0, 0, 1), (0, 0)),  # behind
        ((0, 0, 1), (-0.0, 0, 1), (0, 2)),  # negative zero
        ((5, 5, 5), (1, 0, 0), (0, 0)),  # misses
        ((0, 0, 1), (1e-6, 0, 1), (0, 2)),  # nearly parallel
        ((0, 0, 1), (-1e-6, 0, 1), (0, 2)),
    ],
)
def test_special_rays(origin: tuple[float, ...], direction: tuple[float, ...], expected: tuple[float, float]) -> None:
    enter, leave = intersect_box(torch.tensor([origin]).double(), torch.tensor([direction]).double(), BOX)
    assert (enter.item(), leave.item()) == pytest.approx(expected, abs=1e-9)


def test_a_ray_through_an_edge_has_no_length() -> None:
    enter, leave = intersect_box(torch.tensor([[2.0, 0, 1]]).double(), torch.tensor([[-1.0, 1, 0]]).double(), BOX)
    assert (leave - enter).item() == pytest.approx(0, abs=1e-12)


def test_no_rays() -> None:
    enter, leave = intersect_box(torch.zeros(0, 3), torch.zeros(0, 3), BOX.float())
    assert enter.shape == leave.shape == (0,)


def test_unit_box_maps_corners() -> None:
    torch.testing.assert_close(to_unit_box(BOX, BOX), torch.tensor([[0.0] * 3, [1.0] * 3]).double())


def test_contraction_is_the_papers() -> None:
    x = torch.randn(1000, 3, dtype=torch.float64) * 3
    norm = x.norm(dim=-1, keepdim=True)
    expected = torch.where(norm <= 1, x, (2 - 1 / norm) * x / norm)
    torch.testing.assert_close(contract(x), expected)
    assert bool((contract(x).norm(dim=-1) < 2).all())
    assert torch.autograd.gradcheck(contract, x[:20].clone().requires_grad_())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("x", [0.0, 1e-30, 1e-10, 1.0, 1e10, 1e20, 1e30, float("inf"), -float("inf")])
def test_contraction_is_finite_everywhere(x: float, dtype: torch.dtype) -> None:
    point = torch.tensor([[x, 0.0, 0.0]], dtype=dtype, requires_grad=True)
    out = contract(point)
    out.sum().backward()
    assert point.grad is not None
    assert bool(torch.isfinite(out).all())
    assert bool(torch.isfinite(point.grad).all())
    expected = x if abs(x) <= 1 else (1 if x > 0 else -1) * 2.0
    assert out[0, 0].item() == pytest.approx(expected, rel=2e-7, abs=2e-10)
