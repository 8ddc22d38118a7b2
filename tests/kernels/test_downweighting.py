"""Weights of a grid's levels against the share of a normal distribution that lies in a cell."""

import pytest
import torch
from scipy.stats import norm

from nerfloom.kernels.grids.downweighting import level_weights

RESOLUTIONS = torch.tensor([1, 16, 100, 8192])
DEVIATIONS = torch.logspace(-7, 3, 41, dtype=torch.float64)


def test_a_weight_is_the_share_of_a_gaussian_within_half_a_cell() -> None:
    found = level_weights(DEVIATIONS, RESOLUTIONS)
    half_cells = 0.5 / RESOLUTIONS.double()
    truth = 2 * norm.cdf(half_cells / DEVIATIONS[:, None]) - 1
    assert found.numpy() == pytest.approx(truth, rel=1e-9, abs=1e-15)


def test_the_gradient_is_the_densitys_at_the_cells_border() -> None:
    """The chain rule gives it: d/ds of 2 Phi(h / s) - 1 is -2 phi(h / s) h / s^2."""
    deviations = DEVIATIONS.clone().requires_grad_()
    level_weights(deviations, RESOLUTIONS).sum().backward()
    half_cells, s = 0.5 / RESOLUTIONS.double(), DEVIATIONS[:, None]
    truth = (-2 * norm.pdf(half_cells / s) * (half_cells / s**2).numpy()).sum(-1)
    assert deviations.grad is not None
    assert deviations.grad.numpy() == pytest.approx(truth, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32, torch.float64])
def test_points_without_size_and_endless_ones(dtype: torch.dtype) -> None:
    deviations = torch.tensor([0.0, 1e-30, 1e30, torch.inf], dtype=dtype, requires_grad=True)
    weights = level_weights(deviations, RESOLUTIONS)
    assert weights.dtype == (torch.float64 if dtype == torch.float64 else torch.float32)
    assert weights[:2].eq(1).all()
    assert weights[2:].abs().max().item() < 1e-25
    weights.sum().backward()
    assert deviations.grad is not None
    assert bool(deviations.grad.isfinite().all())


def test_a_nan_is_not_hidden() -> None:
    weights = level_weights(torch.tensor([torch.nan, 0.1]), RESOLUTIONS)
    assert bool(weights[0].isnan().all())
    assert bool(weights[1].isfinite().all())
