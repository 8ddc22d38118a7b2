"""The browser that opens pages."""

import shutil
from collections.abc import Iterator

import pytest

from tests.viewer.chromium import NAMES, Chromium, chromium


@pytest.fixture(scope="session")
def browser() -> str:
    """The path of Chromium."""
    for name in NAMES:
        if found := shutil.which(name):
            return found
    pytest.skip("there is no Chromium; the page is not opened")


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    """A running Chromium, where time passes as for a person."""
    with chromium(tmp_path_factory.mktemp("chromium")) as found:
        yield found
