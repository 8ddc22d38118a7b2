"""Fills in the tables of the pages from docs/results: `python -m docs.building.tables`.

- A table with a last column headed `result` names a row of a file of results in each line. Cells under headings of
  `python -m benchmarks tables` get the values of that row, with the mean and the spread over its seeds; all others
  stay.
- A table behind `<!-- results: NAME: HEADING, HEADING -->` shows these headings in every cell, of the result called
  NAME. ROW is the first word in backticks of the line and COLUMN the heading of the column. With `best` behind
  a second colon the highest PSNR of a line is bold.
- A table behind `<!-- measured: NAME -->` has the lines of that name in `measured.py`.
- A figure of a sentence is before a comment on its line that names result and heading, as in `33.5 dB<!--
  lego-nerfacto-300s: test PSNR -->`. Its number becomes the mean over the seeds, with as many digits behind the point.
  Between two names, ` - ` is the difference, and ` / ` the ratio: `<!-- NAME - OTHER: test PSNR -->`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from benchmarks.table_text import all_columns, cell
from docs.building.measured import TABLES
from nerfloom.benchmarks.results import read_rows

DOCS = Path(__file__).parents[1]
PAGES = ("../README.md", *sorted(page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")))
"""The pages that may have such tables and figures."""
COLUMNS = {column[0]: column for column in all_columns(("1", "1/2", "1/4", "1/8"), {})}
MARK = re.compile(
    r"<!-- (results: (?P<name>[\w.-]+): (?P<shown>[^:]+?)(?P<best>: best)?|measured: (?P<table>[\w-]+)) -->"
)
FIGURE = re.compile(
    r"(?P<number>-?\d[\d,]*(?:\.\d+)?)(?P<rest>[^\d<|\n]{0,12}"
    r"<!-- (?P<one>[\w.-]+)(?: (?P<sign>[-/]) (?P<other>[\w.-]+))?: (?P<heading>[^:>\n]+) -->)"
)
Rows = Mapping[str, Any]
"""Results by name."""


def all_rows(folder: Path = DOCS / "results") -> dict[str, Any]:
    """Return the evaluations in all files of results."""
    files = [file for file in sorted(folder.glob("*.json")) if '"per_image"' in file.read_text(encoding="utf-8")]
    return {name: row for file in files for name, row in read_rows(file).items()}


def filled(page: str, rows: Rows) -> str:
    """Return a page with its tables and the figures of its sentences filled in.

    Args:
        page: the Markdown.
        rows: results by name.

    Raises:
        KeyError: if a table or a sentence names a result, a heading or a value that is not there.
    """
    lines: list[str] = []
    mark: re.Match[str] | None = None
    headings: list[str] | None = None
    for line in page.splitlines():
        if not line.startswith("|"):
            mark, headings = MARK.fullmatch(line) or (mark if not line and headings is None else None), None
        elif headings is None:
            headings = _cells(line)
        elif line.startswith("|---"):
            pass
        elif mark is not None and mark["table"]:
            if lines[-1].startswith("|---"):
                lines += map(_joined, TABLES[mark["table"]]())
            continue
        elif mark is not None and (first := re.match(r"\| `([\w.-]+)", line)):
            line = _joined([_cells(line)[0], *_of_columns(first[1], headings[1:], mark, rows)])
        elif headings[-1] == "result" and (named := re.search(r"\| `([\w.-]+)` \|$", line)):
            line = _joined(_of_result(seeds(named[1], rows), headings, _cells(line)))
        lines.append(line)
    return FIGURE.sub(lambda figure: _figure(figure, rows), "\n".join(lines) + "\n")


def _figure(found: re.Match[str], rows: Rows) -> str:
    """Return a figure of a sentence and its comment, with the value that the comment names."""
    value, digits = _mean(found["one"], found["heading"], rows), len(found["number"].partition(".")[2])
    if found["other"] is not None:
        other = _mean(found["other"], found["heading"], rows)
        value = value - other if found["sign"] == "-" else value / other
    return f"{value:,.{digits}f}{found['rest']}"


def _mean(name: str, heading: str, rows: Rows) -> float:
    """Return the mean of a column over the seeds of a result."""
    values = [value for value in map(COLUMNS[heading][1], seeds(name, rows)) if value is not None]
    if not values:
        raise KeyError(f"the result {name} has no {heading}")
    return fmean(values)


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def _joined(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _of_result(runs: Sequence[Any], headings: Sequence[str], cells: Sequence[str]) -> list[str]:
    """Return the cells of a line of a result, filled in under the known headings."""
    pairs = zip(headings, cells, strict=True)
    return [cell(COLUMNS[heading], runs) if heading in COLUMNS else old for heading, old in pairs]


def _of_columns(first: str, headings: Sequence[str], mark: re.Match[str], rows: Rows) -> list[str]:
    """Return the cells of a line of results; missing ones are empty."""
    names = [mark["name"].replace("ROW", first).replace("COLUMN", _slug(heading)) for heading in headings]
    found = [seeds(name, rows) if name in rows else [] for name in names]
    if not any(found):
        raise KeyError(f"there is none of the results {', '.join(names)}")
    shown = [COLUMNS[heading] for heading in mark["shown"].split(", ")]
    cells = [", ".join(filter(None, (cell(column, runs) for column in shown))) for runs in found]
    if mark["best"]:
        means = [fmean(run["results"]["psnr"] for run in runs) if runs else 0.0 for runs in found]
        best = means.index(max(means))
        cells[best] = f"**{cells[best]}**"
    return cells


def _slug(heading: str) -> str:
    """Return a heading as a part of a result's name: `zip-nerf`, `nerfacto` free space, 45 s."""
    return re.sub(r"(\d)-s$", r"\1s", re.sub(r"[^\w.-]+", "-", heading.replace("`", "")))


def seeds(name: str, rows: Rows) -> list[Any]:
    """Return a result and the results of its further seeds.

    Args:
        name: name of the result.
        rows: results by name.

    Raises:
        KeyError: if it is not there.
    """
    return [rows[name], *(row for other, row in rows.items() if re.fullmatch(rf"{re.escape(name)}-seed\d+", other))]


def main() -> None:
    """Fill in the pages, in place."""
    rows = all_rows()
    for page in PAGES:
        path = DOCS / page
        path.write_text(filled(path.read_text(encoding="utf-8"), rows), encoding="utf-8")


if __name__ == "__main__":
    main()
