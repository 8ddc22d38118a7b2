"""Losses that replace images: optical depth before cameras, and the roughness of depth, in closed form."""

import pytest
import torch
from torch import Tensor

from nerfloom.geometry.rays import Samples
from nerfloom.losses.functions import density_before, depth_roughness

SIDE = 4


def regular(edges: Tensor, rays: int) -> Samples:
    """Intervals between `edges` (S + 1,), the same on each ray."""
    return Samples.regular(edges[:-1].expand(rays, -1), edges[1:].expand(rays, -1))


def walls(depths: Tensor, opacity: float = 1.0) -> tuple[Tensor, Samples]:
    """One sample on each ray at `depths` (R,), with a weight."""
    thin = 1e-4
    samples = Samples.regular(depths[:, None] - thin, depths[:, None] + thin)
    return torch.full_like(depths, opacity), samples


@pytest.mark.parametrize(("distance", "expected"), [(0.1, 0.0), (0.5, 0.0), (1.25, 3 * 0.75), (2.0, 4.5), (9.0, 7.5)])
def test_density_before_a_distance_is_its_integral(distance: float, expected: float) -> None:
    """Density 3 from 0.5 to 3, in intervals of different lengths; the distance may cut one of them."""
    samples = regular(torch.tensor([0.5, 0.6, 1.0, 1.7, 2.4, 3.0], dtype=torch.float64), 7)
    sigma = torch.full((35,), 3.0, dtype=torch.float64, requires_grad=True)
    loss = density_before(samples.evaluated(sigma, sigma[:, None]), distance)
    assert float(loss.detach()) == pytest.approx(expected)
    loss.backward()
    lengths = (samples.t_ends.clamp(max=distance) - samples.t_starts).clamp(min=0)
    torch.testing.assert_close(sigma.grad, lengths / 7)


def test_rays_count_alike_however_many_samples_they_have() -> None:
    ends = torch.tensor([1.0, 1.0, 2.0, 3.0])
    samples = Samples(ends - 1, ends, torch.tensor([0, 1, 4, 4]))
    sigma = torch.tensor([5.0, 1.0, 1.0, 7.0])
    assert float(density_before(samples.evaluated(sigma, sigma[:, None]), 2.0)) == pytest.approx((5 + 2 + 0) / 3)


def test_samples_without_density_are_refused() -> None:
    with pytest.raises(ValueError, match="density"):
        density_before(regular(torch.tensor([0.0, 1.0]), 1), 1.0)


def test_a_plane_across_the_view_is_smooth() -> None:
    """At any distance: what counts is relative to the patch."""
    for depth in (0.1, 1.0, 500.0):
        assert float(depth_roughness(*walls(torch.full((2 * SIDE**2,), depth)), SIDE)) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("scale", [0.01, 1.0, 300.0])
def test_a_slanted_plane_is_as_rough_as_it_is_slanted(scale: float) -> None:
    """Inverse depth 1 + 0.1 per column and 0.2 per row, over its mean 1.45; 12 of 16 places have each neighbour."""
    rows, columns = torch.meshgrid(torch.arange(4.0), torch.arange(4.0), indexing="ij")
    inverse = (1 + 0.1 * columns + 0.2 * rows).double()
    found = depth_roughness(*walls(scale / inverse.reshape(-1)), SIDE)
    assert float(found) == pytest.approx((0.1**2 + 0.2**2) / 1.45**2, rel=1e-3)


def test_what_nobody_sees_is_not_rough() -> None:
    """Where a ray is transparent it has no depth: an edge of an object against nothing costs nothing."""
    depths = torch.ones(SIDE**2, dtype=torch.float64)
    depths[:8] = 100.0
    weights, samples = walls(depths)
    weights[:8] = 0.0
    assert float(depth_roughness(weights, samples, SIDE)) == pytest.approx(0, abs=1e-9)
    assert float(depth_roughness(torch.zeros_like(weights), samples, SIDE)) == 0


def test_depth_is_the_mean_of_inverse_depths_whatever_the_opacity() -> None:
    """Two samples a ray, half transparent: neighbours count by the product of their opacities."""
    t = torch.tensor([1.0, 2.0], dtype=torch.float64)
    samples = Samples.regular((t - 1e-6).expand(4, 2), (t + 1e-6).expand(4, 2))
    weights = torch.tensor([[0.5, 0.0], [0.0, 0.5], [0.5, 0.0], [0.0, 0.5]], dtype=torch.float64).reshape(-1)
    found = depth_roughness(weights, samples, 2)  # inverse depths 1, 1/2; 1, 1/2 over 3/4
    assert float(found) == pytest.approx(2 * 0.25 * (0.5 / 0.75) ** 2 / 2, rel=1e-4)


def test_the_gradient_pulls_depths_together() -> None:
    torch.manual_seed(0)
    edges = torch.linspace(1, 3, 6, dtype=torch.float64)
    samples = regular(edges, 2 * SIDE**2)
    logits = torch.randn(2 * SIDE**2, 5, dtype=torch.float64, requires_grad=True)

    def loss(values: Tensor) -> Tensor:
        return depth_roughness(values.softmax(-1).reshape(-1), samples, SIDE)  # opaque: the detached share is 1

    first = loss(logits)
    (gradient,) = torch.autograd.grad(first, logits)
    assert float(loss(logits.detach() - 0.5 * gradient / gradient.norm())) < float(first)
    assert bool(torch.isfinite(gradient).all())
