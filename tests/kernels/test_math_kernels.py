"""Functions that must stay finite where their plain form does not."""

import math

import pytest
import torch

from nerfloom.kernels.math import cross_matrix, safe_normalize, truncated_exp


@pytest.mark.parametrize("x", [-1e30, -100.0, 0.0, 3.0, 14.9])
def test_truncated_exp_is_exp_below_the_limit(x: float) -> None:
    value = torch.tensor(x, dtype=torch.float64, requires_grad=True)
    out = truncated_exp(value)
    out.backward()
    assert out.item() == pytest.approx(math.exp(x), rel=1e-12)
    assert value.grad is not None
    assert value.grad.item() == pytest.approx(math.exp(x), rel=1e-12)


@pytest.mark.parametrize("x", [15.0, 89.0, 1e30, math.inf])
def test_truncated_exp_is_finite_above_it_and_can_come_down(x: float) -> None:
    value = torch.tensor(x, requires_grad=True)
    out = truncated_exp(value)
    out.backward()
    assert out.item() == pytest.approx(math.exp(15), rel=1e-5)
    assert value.grad is not None
    assert value.grad.item() == pytest.approx(math.exp(15), rel=1e-5)


def test_truncated_exp_leaves_half_precision() -> None:
    assert truncated_exp(torch.tensor([12.0], dtype=torch.float16)).dtype == torch.float32


def test_safe_normalize() -> None:
    v = torch.tensor([[3.0, 0, 4], [0, 0, 0], [1e-30, 0, 0]], requires_grad=True)
    out = safe_normalize(v)
    torch.testing.assert_close(out, torch.tensor([[0.6, 0, 0.8], [0, 0, 0], [0, 0, 0]]))
    out.sum().backward()
    assert v.grad is not None
    assert bool(torch.isfinite(v.grad).all())
    assert torch.autograd.gradcheck(safe_normalize, torch.randn(4, 3, dtype=torch.float64, requires_grad=True))


def test_cross_matrix_is_the_cross_product() -> None:
    a, b = torch.randn(2, 5, 3, generator=torch.Generator().manual_seed(0)).unbind(0)
    torch.testing.assert_close((cross_matrix(a) @ b[..., None])[..., 0], torch.linalg.cross(a, b))
