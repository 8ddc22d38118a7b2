"""Kernels are tested on two threads, on which their chunks meet."""

import pytest


@pytest.fixture(autouse=True)
def _two_threads(two_threads: None) -> None:
    pass
