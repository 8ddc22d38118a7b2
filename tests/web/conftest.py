"""The browser that opens pages."""

import shutil

import pytest

from tests.viewer.chromium import NAMES


@pytest.fixture(scope="session")
def browser() -> str:
    """The path of Chromium."""
    for name in NAMES:
        if found := shutil.which(name):
            return found
    pytest.skip("there is no Chromium; the page is not opened")
