"""The compiled frequency encoding against the reference in float64."""

import pytest
import torch

from nerfloom.kernels.encodings.frequency import frequency_encoding, frequency_encoding_reference
from tests.kernels.compiled import needs_kernels, relative_error

pytestmark = needs_kernels


@pytest.mark.parametrize("dims", [1, 3, 5])
@pytest.mark.parametrize("frequencies", [0, 1, 10])
@pytest.mark.parametrize("include_input", [True, False])
def test_value_and_gradient(dims: int, frequencies: int, include_input: bool) -> None:
    torch.manual_seed(0)
    x = torch.rand(333, dims) * 6 - 3
    found_x, true_x = x.clone().requires_grad_(), x.double().requires_grad_()
    found = frequency_encoding(found_x, frequencies, include_input)
    truth = frequency_encoding_reference(true_x, frequencies, include_input)
    assert found.shape == truth.shape
    assert relative_error(found, truth) < 3e-7  # 2^k x is exact in float32, so the angle is too
    if truth.shape[1]:
        grad = torch.randn_like(truth)
        found.backward(grad.float())
        truth.backward(grad)
        assert found_x.grad is not None
        assert true_x.grad is not None
        assert relative_error(found_x.grad, true_x.grad) < 2e-6


def test_large_angles_and_what_is_no_number() -> None:
    x = torch.tensor([[0.0, -0.0, 8192.0], [1e5, -3e7, 1e30], [float("inf"), -float("inf"), float("nan")]])
    found = frequency_encoding(x, 1, include_input=False)
    truth = frequency_encoding_reference(x.double(), 1, include_input=False)
    assert relative_error(found[:2], truth[:2]) < 3e-7
    assert bool(found[2].isnan().all())


def test_empty_input_and_thread_counts() -> None:
    x = torch.rand(1001, 3)
    results = []
    before = torch.get_num_threads()
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(frequency_encoding(x, 10))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])
    assert frequency_encoding(x[:0], 10).shape == (0, 63)
