"""The time to wait for an expected event: against hanging alone, as no test is about speed."""

import time
from collections.abc import Callable
from typing import TypeVar

PATIENCE = 600.0
"""Maximum seconds of waiting; then a test counts the event as hanging."""
Found = TypeVar("Found")


def until(found: Callable[[], Found]) -> Found:
    """Wait for something true, and return it."""
    end = time.monotonic() + PATIENCE
    while not (result := found()):
        assert time.monotonic() < end, "it does not happen"
        time.sleep(0.005)
    return result
