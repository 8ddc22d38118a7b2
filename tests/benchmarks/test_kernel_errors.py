"""Errors of kernels as they are reported; the kernels themselves are compared in tests/kernels/triton."""

import math

import pytest
import torch

from nerfloom.benchmarks.kernel_cases import KINDS, cases
from nerfloom.benchmarks.kernel_errors import largest_error
from nerfloom.kernels.dispatch import TRITON, table


@pytest.mark.parametrize(
    ("value", "truth", "error"),
    [
        ([1.0, 2.0], [1.0, 2.5], 0.2),
        ([0.0, 0.0], [0.0, 1e-9], 1e-3),  # of at least 1e-6
        ([math.inf, 1.0], [math.inf, 1.0], 0.0),
        ([math.inf, 1.0], [1e39, 1.0], 0.0),  # which float32 does not hold
        ([math.nan, 1.0], [1.0, 1.0], math.inf),
        ([1.0, 1.0], [math.nan, 1.0], math.inf),
        ([1.0], [1.0, 1.0], math.inf),
        ([], [], 0.0),
    ],
)
def test_an_error_is_relative_to_the_largest_value(value: list[float], truth: list[float], error: float) -> None:
    found = largest_error(torch.tensor(value), torch.tensor(truth, dtype=torch.float64))
    assert found == pytest.approx(error)


def test_every_operation_of_tritons_has_inputs_of_each_kind() -> None:
    every = [(case.kernel, case.kind) for case in cases()]
    assert len(set(every)) == len(every)
    kernels = {kernel for kernel, _ in every}
    assert every == [(kernel, kind) for kernel in dict.fromkeys(name for name, _ in every) for kind in KINDS]
    listed = {name for name, backends in table().items() if TRITON.name in backends}
    assert listed == kernels
