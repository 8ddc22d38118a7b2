"""Kernels are tested on two threads, so that chunks of both meet."""

import pytest


@pytest.fixture(autouse=True)
def _two_threads(two_threads: None) -> None:
    pass
