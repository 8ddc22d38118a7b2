"""Input as programs hand it over: every other column of something, transposed, half precision, one row, none."""

from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from nerfloom.geometry.rays import Samples
from nerfloom.kernels.compositing.density import distortion
from nerfloom.kernels.encodings.frequency import frequency_encoding
from tests.kernels.compiled import relative_error
from tests.kernels.distortion_by_pairs import distortion_by_pairs
from tests.stress.backends import FEW, backends
from tests.stress.test_encodings import ANY_SHAPE, ROWS

FUNCTIONS: dict[str, Callable[[Tensor], Tensor]] = {
    **ROWS,
    **ANY_SHAPE,
    "frequencies": lambda x: frequency_encoding(x, 4),
}
"""Functions that take (N, 3)."""
any_function = st.sampled_from(list(FUNCTIONS))


def some(*shape: int) -> Tensor:
    """The same numbers in [0, 0.9) each time."""
    return torch.rand(*shape, generator=torch.Generator().manual_seed(0)) * 0.9


@pytest.mark.entry(12)
@backends()
@FEW
@given(name=any_function, count=st.integers(0, 5), stride=st.integers(2, 3), transposed=st.booleans())
def test_rows_that_do_not_stand_side_by_side(
    backend: str, name: str, count: int, stride: int, transposed: bool
) -> None:
    """Value and gradient equal a copy's."""
    x = some(3, count).t() if transposed else some(count, 3 * stride)[:, ::stride]
    part, copy = x.detach().requires_grad_(), x.contiguous().detach().requires_grad_()
    found, truth = FUNCTIONS[name](part), FUNCTIONS[name](copy)
    torch.testing.assert_close(found, truth)
    assert found.requires_grad == truth.requires_grad
    if truth.requires_grad:
        (slope,) = torch.autograd.grad(found.square().sum(), part)
        (true_slope,) = torch.autograd.grad(truth.square().sum(), copy)
        torch.testing.assert_close(slope, true_slope)


@pytest.mark.entry(1, 12)
@backends()
@FEW
@given(name=any_function, count=st.integers(0, 5), dtype=st.sampled_from([torch.float16, torch.bfloat16]))
def test_half_precision_is_right_to_its_own_rounding_or_refused(
    backend: str, name: str, count: int, dtype: torch.dtype
) -> None:
    """A result in single precision must be accurate to single precision."""
    x = some(count, 3).to(dtype)
    try:
        found = FUNCTIONS[name](x)
    except (ValueError, RuntimeError):
        return
    tolerance = 32 * torch.finfo(found.dtype).eps
    torch.testing.assert_close(found.float(), FUNCTIONS[name](x.float()), rtol=tolerance, atol=tolerance)


@pytest.mark.entry(12, 21)
@backends()
@FEW
@given(rays=st.integers(0, 3), bins=st.integers(1, 5), stride=st.integers(1, 3))
def test_distortion_of_weights_that_do_not_stand_side_by_side(backend: str, rays: int, bins: int, stride: int) -> None:
    edges = some(rays, bins + 1).cumsum(-1)
    weights = some(rays * bins * stride)[::stride].requires_grad_()
    exact = weights.detach().double().requires_grad_()
    truth = distortion_by_pairs(exact, Samples.regular(edges[:, :-1].double(), edges[:, 1:].double()))
    found = distortion(weights, Samples.regular(edges[:, :-1], edges[:, 1:]))
    (slope,) = torch.autograd.grad(found.sum(), weights)
    (true_slope,) = torch.autograd.grad(truth.sum(), exact)
    assert found.shape == (rays,)
    assert relative_error(found, truth) < 1e-3
    assert relative_error(slope, true_slope) < 1e-3
