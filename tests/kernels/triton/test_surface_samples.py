"""Samples of a surface: opacities, densities and normals."""

import pytest

from nerfloom.benchmarks.kernel_cases import cases
from tests.kernels.triton.compared import compare

CASES = [case for case in cases() if case.kernel.startswith(("surface_samples", "unit_normals"))]


@pytest.mark.parametrize("case", CASES, ids=[f"{case.kernel}-{case.kind}" for case in CASES])
def test_values_and_gradients(case: object) -> None:
    compare(case.run, case.inputs, case.followed)  # type: ignore[attr-defined]
