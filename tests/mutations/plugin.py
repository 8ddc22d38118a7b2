"""Loaded by pytest in a copy: says which test is running while lines are recorded, and brings tests into an order.

It is told what to do by the environment: `MUTATIONS_RECORD` names a folder for what each process has run,
`MUTATIONS_ORDER` a JSON list of the tests to run, in that order, and `MUTATIONS_FAILED` a file for what fails.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

RECORD, ORDER, FAILED, CONTEXT = "MUTATIONS_RECORD", "MUTATIONS_ORDER", "MUTATIONS_FAILED", "MUTATIONS_CONTEXT"


def fixture_context(fixture: Any) -> str | None:
    """The name under which a fixture's lines are recorded, where several tests share it."""
    return None if fixture.scope == "function" else f"{fixture.scope} fixture {fixture.baseid}::{fixture.argname}"


class Recorder:
    """Lines that this process runs, by the test or the shared fixture that they were run for.

    Processes that a test starts find its name in their environment (`startup.py`).
    """

    def __init__(self, folder: Path) -> None:
        import coverage

        self.folder = folder
        self.fixtures: dict[str, list[str]] = {}
        self.seconds: dict[str, float] = {}
        self.failed: list[str] = []
        self.coverage = coverage.Coverage(config_file=str(folder / "coveragerc"), data_suffix=True)
        self.coverage.start()

    def enter(self, context: str) -> str:
        """Returns: the context before."""
        before = os.environ.get(CONTEXT, "")
        os.environ[CONTEXT] = context
        self.coverage.switch_context(context)
        return before

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Function) -> Iterator[None]:
        definitions = item._fixtureinfo.name2fixturedefs.values()
        shared = {fixture_context(fixture) for several in definitions for fixture in several}
        self.fixtures[item.nodeid] = sorted(name for name in shared if name is not None)
        self.enter(item.nodeid)
        try:
            return (yield)
        finally:
            self.enter("")

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[Any]:
        name = fixture_context(fixturedef)
        before = None if name is None else self.enter(name)
        try:
            return (yield)
        finally:
            if before is not None:
                self.enter(before)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.seconds[report.nodeid] = self.seconds.get(report.nodeid, 0.0) + report.duration
        if report.failed:
            self.failed.append(report.nodeid)

    def pytest_sessionfinish(self) -> None:
        self.coverage.stop()
        self.coverage.save()
        content = {"fixtures": self.fixtures, "seconds": self.seconds, "failed": self.failed}
        (self.folder / f"tests-{os.getpid()}.json").write_text(json.dumps(content))


def pytest_configure(config: pytest.Config) -> None:
    distributes = bool(config.getoption("numprocesses", None)) and not hasattr(config, "workerinput")
    if RECORD in os.environ and not distributes:
        config.pluginmanager.register(Recorder(Path(os.environ[RECORD])))


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if ORDER not in os.environ:
        return
    rank = {name: place for place, name in enumerate(json.loads(Path(os.environ[ORDER]).read_text()))}
    config.hook.pytest_deselected(items=[item for item in items if item.nodeid not in rank])
    items[:] = sorted((item for item in items if item.nodeid in rank), key=lambda item: rank[item.nodeid])


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    if report.failed and FAILED in os.environ:
        with Path(os.environ[FAILED]).open("a") as file:
            file.write(report.nodeid + "\n")
