"""Adam of rows: only rows with a gradient are updated."""

import math

import pytest
import torch
from torch import Tensor

from nerfloom.kernels.adam.adam import sparse_adam
from tests.kernels.triton.compared import compare


def updated(betas: tuple[float, float], found_inf: float | None = None):
    def run(values: Tensor, grad: Tensor, mean: Tensor, square: Tensor, seen: Tensor) -> tuple[Tensor, ...]:
        rate, verdict = 0.01, None
        if found_inf is not None:
            rate, verdict = torch.full((), 0.01, device=values.device), torch.full((), found_inf, device=values.device)
        count = sparse_adam(values, grad, mean, square, seen, rate, betas, 1e-15, verdict)
        return values, grad, mean, square, seen, torch.as_tensor(count, dtype=torch.int64)

    return run


@pytest.mark.parametrize(("entries", "features"), [(0, 2), (1, 1), (300, 2), (50, 3), (9, 32)])
def test_rows(entries: int, features: int) -> None:
    torch.manual_seed(0)
    given = {name: torch.rand(entries, features) for name in ("values", "grad", "mean", "square")}
    given["grad"] *= torch.rand(entries, 1) > 0.5
    given["grad"] *= torch.rand(entries, features) > 0.5
    given["seen"] = torch.randint(0, 40, (entries,)).float()
    compare(updated((0.9, 0.999)), given)


@pytest.mark.parametrize("found_inf", [0.0, 1.0])
def test_rate_and_verdict_on_the_device(found_inf: float) -> None:
    torch.manual_seed(0)
    given = {name: torch.rand(40, 2) for name in ("values", "grad", "mean", "square")}
    given["grad"] *= torch.rand(40, 1) > 0.5
    given["seen"] = torch.randint(0, 40, (40,)).float()
    values, grad, *_, count = compare(updated((0.9, 0.999), found_inf), given)
    assert not grad.any()
    assert (int(count) == 0) == torch.equal(values.cpu(), given["values"]) == bool(found_inf)


def test_extremes() -> None:
    """First updates and those after a million, gradients from 1e-18 to 1e18, NaN, and no memory at all."""
    values, zeros = torch.ones(6, 2), torch.zeros(6, 2)
    grad = torch.tensor([[1e-18, 0.0], [1e18, -1e18], [0.0, 0.0], [math.nan, 1.0], [1.0, 2.0], [1.0, -0.0]])
    seen = torch.tensor([0.0, 0.0, 3.0, 1.0, 1e6, 5e3])
    given = {"values": values, "grad": grad, "mean": zeros, "square": zeros, "seen": seen}
    compare(updated((0.9, 0.99)), given)
    compare(updated((0.0, 0.0)), given)
