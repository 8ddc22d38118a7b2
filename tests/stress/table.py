"""The known numerical failures of the field, and the result of each on each backend, as a table in Markdown."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from tests.stress.backends import BACKENDS

SHARED = "shared"
"""The column of code that all backends share."""
ABSENT = {"Triton interpreter": "does not apply: there are no Triton kernels yet"}
"""Columns of backends that are still to be written, and their content."""
COLUMNS = (*BACKENDS, *ABSENT, SHARED)
ENTRIES = {
    1: "exp and softplus overflow: 12 in half precision, 89 in single",
    2: "Adam's epsilon of 1e-8 is 0 in half precision",
    3: "NaN and rounding that accumulate: running sums over 100,000 steps or samples",
    4: "every ray empty, no sample in a batch",
    5: "samples in empty cells by rounding; NaN in the density grid",
    6: "infinite gradients and the gradient scaler's checks",
    7: "density that is dead at the start: all photographs white, black or transparent",
    8: "0 / 0 in disparity; intervals without length; infinite density times no length",
    9: "contraction: NaN gradient at the origin, overflow at 1e20",
    10: "variance of a conical frustum from 100 to 100.01",
    11: "1 - exp(-x) loses what is below 6e-8",
    12: "NaN density that becomes zero weights; functions given two batch dimensions",
    13: "sampling a PDF: no weight, bins without width, u = 1, the CDF's end",
    14: "near = 0 with even disparity; far = inf; another near in evaluation",
    15: "NaN gradients through torch.where: piecewise spacing, sRGB",
    16: "rays parallel to a box's faces, inside, on faces, at corners",
    17: "normals of what has no length, and their range where stored",
    18: "rotation exponentials at the angle 0",
    19: "hash grid at x = 1, half-precision coordinates, second derivatives",
    20: "frequency encoding at x = 1000",
    21: "distortion loss where all mass is near s = 1",
    22: "metrics: SSIM's data range, black against black, PSNR of identical images, LPIPS's range",
    23: "depth that depends on the chunk size",
    24: "undistortion that converges to a wrong root",
    25: "total variation of planes whose sides differ",
}


@dataclass
class Cell:
    """The results of the tests of one entry on one backend."""

    passed: int = 0
    failed: list[str] = field(default_factory=list)
    """Names of tests."""
    known: list[str] = field(default_factory=list)
    """Why tests that are expected to fail do."""
    skipped: list[str] = field(default_factory=list)
    """Why tests did not run."""

    def text(self) -> str:
        """The result in a few words."""
        parts = []
        if self.failed:
            parts.append(f"**FAIL**: {', '.join(self.failed)}")
        if self.passed:
            parts.append(f"pass ({self.passed})")
        if self.known:
            parts.append(f"known to fail: {'; '.join(dict.fromkeys(self.known))}")
        if self.skipped:
            said = "; ".join(dict.fromkeys(self.skipped))
            parts.append(f"not run: {said}" if parts else f"does not apply: {said}")
        return "; ".join(parts).replace("|", "\\|").replace("\n", " ")


class Table:
    """Cells by entry and backend."""

    def __init__(self) -> None:
        self.cells: dict[tuple[int, str], Cell] = {}

    def add(self, entries: list[int], backend: str, report: pytest.TestReport) -> None:
        """Take note of a phase of a test. Setting up and tearing down count where they do not pass."""
        for entry in entries:
            cell = self.cells.setdefault((entry, backend), Cell())
            if report.outcome == "failed":
                cell.failed.append(report.nodeid.rsplit("::", 1)[-1])
            elif hasattr(report, "wasxfail"):
                cell.known.append(report.wasxfail)
            elif report.outcome == "skipped":
                cell.skipped.append(_why_skipped(report))
            elif report.when == "call":
                cell.passed += 1

    def text(self, entry: int, backend: str) -> str:
        """The content of a cell."""
        if backend in ABSENT:
            return ABSENT[backend]
        if (entry, backend) in self.cells:
            return self.cells[entry, backend].text()
        if not any(number == entry for number, _ in self.cells):
            return "not run"
        return "does not apply: kernels alone" if backend == SHARED else "does not apply: no kernel takes part"

    def markdown(self) -> str:
        """The whole table."""
        rows = [["", "failure", *COLUMNS], ["---"] * (len(COLUMNS) + 2)]
        rows += [[str(n), what, *(self.text(n, column) for column in COLUMNS)] for n, what in ENTRIES.items()]
        return "".join(f"| {' | '.join(row)} |\n" for row in rows)


class TableWriter:
    """A plugin of pytest that keeps the table and writes it at the end."""

    def __init__(self, file: Path) -> None:
        self.file, self.table = file, Table()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        said = dict(report.user_properties)
        if "entries" in said:
            self.table.add(said["entries"], said["backend"], report)

    def pytest_sessionfinish(self) -> None:
        self.file.parent.mkdir(parents=True, exist_ok=True)
        self.file.write_text(self.table.markdown(), encoding="utf-8")

    def pytest_terminal_summary(self, terminalreporter: Any) -> None:
        terminalreporter.write_line(f"table of the stress tests: {self.file}")


def entries_of(item: pytest.Item) -> list[int]:
    """The entries that a test is for, by its marks."""
    return sorted({number for mark in item.iter_markers("entry") for number in mark.args})


def _why_skipped(report: pytest.TestReport) -> str:
    reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
    return reason.removeprefix("Skipped: ")
