"""Optical depth right before cameras, in closed form."""

import pytest
import torch
from torch import Tensor

from nerfloom.geometry.rays import Samples
from nerfloom.losses.functions import density_before


def regular(edges: Tensor, rays: int) -> Samples:
    """Intervals between `edges` (S + 1,), the same on each ray."""
    return Samples.regular(edges[:-1].expand(rays, -1), edges[1:].expand(rays, -1))


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
