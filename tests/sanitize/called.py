"""Plugin of pytest: a compiled function that no test has called was not checked, which fails the run."""

from __future__ import annotations

import pytest

from nerfloom.kernels import native
from tests.kernels.test_signatures import declared


def pytest_sessionfinish(session: pytest.Session) -> None:
    found = {name: functions for name, functions in declared().items() if native.has(name)}
    missing = sorted(name for name, those in found.items() if all(each._bound is None for each in those))
    print(f"\n{len(found) - len(missing)} of {len(found)} compiled functions were called")
    if missing:
        print(f"never called: {', '.join(missing)}")
        session.exitstatus = session.exitstatus or pytest.ExitCode.TESTS_FAILED
