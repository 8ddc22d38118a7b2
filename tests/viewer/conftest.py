"""The browser and the run of the tests of the page."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cli.helpers import train
from tests.viewer.chromium import Chromium, chromium


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    with chromium(tmp_path_factory.mktemp("chromium")) as found:
        yield found


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, shared_tiny: Path) -> Path:
    return train(shared_tiny, tmp_path_factory.mktemp("runs"), "--max-num-iterations", 300)
