"""Shared by the stress tests: the implementations of a test, and the number of examples of hypothesis.

A backend is a way to compute the kernels. `reference` is torch alone: kernels are then their `*_reference` functions.
`compiled` is the C++ library, through the public functions. A further one is a name in `BACKENDS`, its requirements in
`MARKS`, and a branch in `switch_to`.
"""

from __future__ import annotations

import pytest
from hypothesis import HealthCheck, settings

from nerfloom.kernels import native
from tests.kernels.compiled import needs_kernels

REFERENCE, COMPILED = "reference", "compiled"
BACKENDS = (REFERENCE, COMPILED)
MARKS = {COMPILED: (needs_kernels,)}

FEW = settings(
    max_examples=40,
    derandomize=True,
    # A backend is switched to once for all examples.
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
"""The same few examples in every run."""


def switch_to(backend: str, patch: pytest.MonkeyPatch) -> None:
    """Until `patch` is undone, everything is computed on a backend: fields, samplers and renderers too."""
    if backend == REFERENCE:
        patch.setattr(native, "available", lambda: False)
        patch.setattr(native, "has", lambda name: False)


def backends(**broken: str) -> pytest.MarkDecorator:
    """Run a test, which takes a `backend`, on each of them.

    Args:
        broken: backends with known failures, and their reasons.
    """
    params = []
    for name in BACKENDS:
        marks = [*MARKS.get(name, ())]
        if name in broken:
            marks.append(pytest.mark.xfail(strict=True, reason=broken[name]))
        params.append(pytest.param(name, marks=marks))
    return pytest.mark.parametrize("backend", params, indirect=True)
