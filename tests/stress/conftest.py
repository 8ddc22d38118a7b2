"""The backends, and the table: `pytest tests/stress --stress-table FILE` writes the result of each entry on each."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.stress.backends import switch_to
from tests.stress.table import SHARED, TableWriter, entries_of


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--stress-table", metavar="FILE", help="write a Markdown table of the known numerical failures")


def pytest_configure(config: pytest.Config) -> None:
    file = config.getoption("stress_table", default=None)
    if file is not None and not hasattr(config, "workerinput"):  # the workers of pytest-xdist report to one writer
        config.pluginmanager.register(TableWriter(Path(file)), "stress-table")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        entries = entries_of(item)
        if entries:
            parameters = item.callspec.params if hasattr(item, "callspec") else {}
            item.user_properties += [("entries", entries), ("backend", parameters.get("backend", SHARED))]


@pytest.fixture
def backend(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The name of the backend that is in use during a test; chosen by `tests.stress.backends.backends`."""
    switch_to(request.param, monkeypatch)
    return request.param
