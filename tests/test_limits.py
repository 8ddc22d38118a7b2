"""Values within limits: value, and a slope of 1 up to the limits themselves on every torch."""

import math

import pytest
import torch

from nerfloom.geometry.bounds import contract
from nerfloom.geometry.limits import at_least, between
from nerfloom.kernels.histograms.spacing import to_disparity
from nerfloom.kernels.math import safe_normalize


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_value_and_slope(dtype: torch.dtype) -> None:
    x = torch.tensor([-math.inf, -1.0, 0.0, 0.25, 1.0, 2.0, math.inf], dtype=dtype, requires_grad=True)
    lower, within = at_least(x, 0.0), between(x, 0.0, 1.0)
    assert lower.dtype == within.dtype == dtype
    assert lower.tolist() == [0, 0, 0, 0.25, 1, 2, math.inf]
    assert within.tolist() == [0, 0, 0, 0.25, 1, 1, 1]
    assert torch.autograd.grad(lower.sum(), x)[0].tolist() == [0, 0, 1, 1, 1, 1, 1]
    assert torch.autograd.grad(within.sum(), x)[0].tolist() == [0, 0, 1, 1, 1, 0, 0]


def test_nan_stays_nan() -> None:
    x = torch.tensor([math.nan], requires_grad=True)
    assert at_least(x, 0.0).isnan().all()
    assert between(x, 0.0, 1.0).isnan().all()


def test_slopes_where_a_limit_is_met_exactly() -> None:
    """Vectors along an axis, positions on an axis, and the place where the two pieces of disparity meet."""
    v = torch.tensor([[3.0, 0.0, 0.0]], requires_grad=True)
    (slope,) = torch.autograd.grad(safe_normalize(v)[0, 0], v)
    assert slope.abs().max() < 1e-6  # a longer one has the same direction
    x = torch.tensor([0.0, 4.0, 0.0], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(contract(x)[1], x)
    torch.testing.assert_close(slope, torch.tensor([0, 1 / 16, 0], dtype=torch.float64))  # of 2 - 1 / x
    t = torch.tensor([1.0], requires_grad=True)
    assert torch.autograd.grad(to_disparity(t).sum(), t)[0].item() == 0.5
