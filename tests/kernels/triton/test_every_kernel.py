"""Every operation that Triton has, at random, extreme and no inputs, as `ns-bench gpu` prints them."""

import pytest

from nerfloom.benchmarks.kernel_cases import KINDS
from nerfloom.benchmarks.kernel_errors import as_table, measured
from tests.kernels.triton.compared import DEVICE

LARGEST = 1e-5


@pytest.mark.slow  # every kernel has tests of its own beside this
def test_errors_of_every_kernel_are_of_rounding() -> None:
    """Errors of cancelling differences are larger than others."""
    rows = measured(DEVICE)
    for row in rows:
        print(row)
        assert row.value < LARGEST
        assert row.gradient is None or row.gradient < LARGEST
    kernels = {row.kernel for row in rows}
    assert len(rows) == len(kernels) * len(KINDS)
    assert len(kernels) > 15
    assert any(row.gradient for row in rows)
    assert as_table(rows).row_count == len(kernels)
