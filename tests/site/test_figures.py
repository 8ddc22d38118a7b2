"""Figures in the documents equal the evaluations that they name, and tables of names the code."""

import json
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from benchmarks.tables import read_table
from nerfloom.base import from_nerfstudio
from nerfloom.base.other_projects import ELSEWHERE
from nerfloom.registry import registered
from tests.site.pages import ROOT

DOCS = ROOT / "docs"
PSNR = re.compile(r"(\d+\.\d+)(?: ± \d+\.\d+)? dB")


def rows(page: Path) -> list[list[str]]:
    lines = page.read_text(encoding="utf-8").splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]


@pytest.fixture
def tables(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """docs/building/tables.py."""
    monkeypatch.syspath_prepend(str(DOCS / "building"))
    import tables as module

    return module


def test_tables_are_those_of_their_results(tables: ModuleType) -> None:
    known = tables.all_rows()
    assert len(known) > 100
    for page in tables.PAGES:
        text = (DOCS / page).read_text(encoding="utf-8")
        assert tables.filled(text, known) == text, f"{page}: python -m docs.building.tables"


def test_figures_stand_on_the_line_of_their_names(tables: ModuleType) -> None:
    """A line's end between the two would leave the figure as it is, and no test would find it stale."""
    for page in tables.PAGES:
        text = re.sub(r"```.*?```|`[^`]*`", "", (DOCS / page).read_text(encoding="utf-8"), flags=re.DOTALL)
        named = re.findall(r"<!--\s(?!measured)[\w.-]+(?:\s[-/]\s[\w.-]+)?:\s[^:>]+-->", text)
        assert len(named) == len(tables.FIGURE.findall(text)), page


def evaluation(psnr: float, **run: float) -> dict[str, Any]:
    return {"results": {"psnr": psnr, "ssim": 0.9, "fps": 4.0}, "run": run, "per_image": []}


def test_cells_are_filled_in_by_name(tables: ModuleType) -> None:
    known = {"a-x-5s": evaluation(31.0, steps=1200), "a-x-5s-seed43": evaluation(32.0, steps=1400)}
    known |= {"a-x-5s-slow": evaluation(9.0, steps=1), "b-x-5s": evaluation(30.0), "b-y-5s": evaluation(28.0)}
    page = """
| run | test PSNR | steps | note | result |
|---|---|---|---|---|
| two | ? | ? | 7 | `a-x-5s` |
| one | ? | ? | 8 | `b-x-5s` |
| other | ? | ? | 9 | |

<!-- results: ROW-COLUMN-5s: test PSNR, SSIM: best -->

| data | `x` | y |
|---|---|---|
| `a`: first | | |
| `b` | | |

| data | x |
|---|---|
| `a` | ? |
"""
    cells = [line for line in tables.filled(page, known).splitlines() if line.startswith("| ")]
    assert cells[1:4] == [
        "| two | 31.50 ± 0.71 dB | 1,300 | 7 | `a-x-5s` |",
        "| one | 30.00 dB |  | 8 | `b-x-5s` |",
        "| other | ? | ? | 9 | |",
    ]
    assert cells[5] == "| `a`: first | **31.50 ± 0.71 dB, 0.900** |  |"
    assert cells[6] == "| `b` | **30.00 dB, 0.900** | 28.00 dB, 0.900 |"
    assert cells[8] == "| `a` | ? |"
    with pytest.raises(KeyError, match="c-x-5s"):
        tables.filled(page.replace("`b`", "`c`"), known)


def test_figures_of_sentences_are_filled_in_by_name(tables: ModuleType) -> None:
    known = {"a-x-5s": evaluation(31.04, steps=1200), "a-x-5s-seed43": evaluation(32.0, steps=1400)}
    known |= {"b-x-5s": evaluation(30.0)}
    page = """In 5 s 7.1 dB<!-- a-x-5s: test PSNR --> after 9<!-- a-x-5s: steps --> steps,
-3.0 dB<!-- b-x-5s - a-x-5s: test PSNR --> and 2.00 times<!-- a-x-5s / b-x-5s: test PSNR -->, 0.25 s/image.
"""
    values = {"7.1 dB": "31.5 dB", " 9<": " 1,300<", "-3.0": "-1.5", "2.00": "1.05"}
    true = page
    for old, new in values.items():
        true = true.replace(old, new)
    assert tables.filled(page, known) == true
    assert tables.filled(true, known) == true
    for wrong in ("c-x-5s: test PSNR", "a-x-5s: test PSRN", "a-x-5s: floaters"):
        with pytest.raises(KeyError):
            tables.filled(f"7 dB<!-- {wrong} -->", known)


def test_results_are_shown_or_rows_of_a_table(tables: ModuleType) -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in DOCS.rglob("*.md"))
    files = (ROOT / "configs" / "tables").glob("*.yml")
    asked = {row.name for file in files for row in read_table(file, Path("data"), Path("runs")).rows}
    shown = {re.sub(r"-seed\d+$", "", name) for name in tables.all_rows()}
    assert [name for name in sorted(shown - asked) if f"`{name}`" not in text] == []


def test_what_stands_beside_published_results_is_in_the_figures() -> None:
    """The fourth column of the table of Lego is ours; its PSNRs are in the table of figures."""
    ours = PSNR.findall(" ".join(row[3] for row in rows(DOCS / "published.md") if len(row) == 5))
    known = (DOCS / "figures.md").read_text()
    assert len(ours) >= 5
    assert [number for number in ours if number not in PSNR.findall(known)] == []


def test_captures_after_each_budget_are_those_of_the_figures() -> None:
    table = [row for row in rows(DOCS / "guides" / "budgets.md") if len(row) == 5]
    numbers = [number for row in table for cell in row[1:] for number in re.findall(r"\d\d\.\d\d", cell)]
    known = PSNR.findall((DOCS / "figures.md").read_text())
    assert len(numbers) >= 18
    assert [number for number in numbers if number not in known] == []


def test_sentences_repeat_the_table() -> None:
    """PSNRs that other pages quote stand in the figures, notes, benchmarks, or beside pictures, perhaps rounded."""
    sources = [DOCS / f"{name}.md" for name in ("figures", "benchmarks", "stability", "plug-and-play")]
    sources += [*(DOCS / "notes").glob("*.md"), *(ROOT / "methods").glob("*.py")]
    numbers = set(re.findall(r"\d+\.\d+", "\n".join(source.read_text() for source in sources)))
    failures = json.loads((DOCS / "pictures" / "failures" / "psnr.json").read_text())["psnr"]
    numbers |= {f"{psnr:.2f}" for row in failures.values() for psnr in row.values()}
    numbers |= {f"{float(number):.1f}" for number in numbers}
    pages = [page for part in ("methods", "guides", "start") for page in (DOCS / part).glob("*.md")]
    pages.append(ROOT / "README.md")
    for page in pages:
        text = re.sub(r"```text.*?```", "", page.read_text(), flags=re.DOTALL)
        assert [number for number in PSNR.findall(text) if number not in numbers] == [], page.name


def test_versions_are_those_that_ran() -> None:
    ran = json.loads((DOCS / "results" / "versions.json").read_text())["rows"]
    table = [row for row in rows(DOCS / "platforms.md") if len(row) == 4]
    assert table[2:] == [[row["python"], row["torch"], row["state"], row["what"]] for row in ran]


def test_flags_of_nerfstudio_are_those_that_are_answered() -> None:
    table = {row[0].strip("`"): row[1].strip("`") for row in rows(DOCS / "from-nerfstudio-names.md") if len(row) == 2}
    assert from_nerfstudio.SETTINGS.items() <= table.items()
    text = (DOCS / "from-nerfstudio.md").read_text()
    assert [name for name in from_nerfstudio.NO_FORMATS if f"`{name}`" not in text] == []


def test_methods_of_nerfstudio_are_those_that_are_answered() -> None:
    """A method in the left column has the name of one here, or is answered when somebody asks for it."""
    table = [row for row in rows(DOCS / "from-nerfstudio-names.md") if len(row) == 2 and "--" not in row[1]]
    named = {name for row in table for name in re.findall(r"`([\w-]+)`", row[0])}
    assert len(named) > 20
    assert sorted(named - set(ELSEWHERE) - set(registered("methods"))) == []


def test_every_data_format_is_named() -> None:
    text = (DOCS / "guides" / "formats.md").read_text()
    entries = registered("dataparsers").items()
    built_in = [name for name, entry in entries if entry.module.startswith("nerfloom.dataparsers.")]
    assert [name for name in built_in if f"`{name}`" not in text] == []
