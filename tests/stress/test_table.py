"""The table itself: every entry has tests, and it reports their results."""

import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.stress.table import COLUMNS, ENTRIES, SHARED, Table, entries_of


def report(outcome: str, when: str = "call", **more: object) -> SimpleNamespace:
    return SimpleNamespace(outcome=outcome, when=when, nodeid="tests/stress/test_x.py::test_it[compiled]", **more)


def test_every_entry_has_tests_and_no_other_is_named() -> None:
    text = "\n".join(file.read_text(encoding="utf-8") for file in Path(__file__).parent.glob("test_*.py"))
    named = {int(n) for numbers in re.findall(r"mark\.entry\(([\d, ]+)\)", text) for n in numbers.split(",")}
    assert named == set(ENTRIES) == set(range(1, 26))


def test_the_document_has_a_row_for_each_entry() -> None:
    text = (Path(__file__).parents[2] / "docs" / "notes" / "numerics.md").read_text(encoding="utf-8")
    assert [int(n) for n in re.findall(r"^\| (\d+) \|", text, re.MULTILINE)] == list(ENTRIES)


def test_every_test_names_its_entry(request: pytest.FixtureRequest) -> None:
    here = Path(__file__)
    tests = [item for item in request.session.items if item.path.parent == here.parent and item.path != here]
    assert [item.name for item in tests if not entries_of(item)] == []


def test_what_the_cells_say() -> None:
    table = Table()
    table.add([8, 11], "reference", report("passed"))
    table.add([8], "reference", report("passed"))
    table.add([8], "reference", report("passed", when="setup"))
    table.add([8], "compiled", report("skipped", longrepr=("file", 3, "Skipped: not installed"), when="setup"))
    table.add([10], SHARED, report("skipped", longrepr=("file", 3, "Skipped: there are no cones")))
    table.add([11], "compiled", report("skipped", wasxfail="0 | 1"))
    table.add([11], "compiled", report("passed"))
    table.add([12], "compiled", report("failed"))
    found = {key: table.text(*key) for key in [(8, "reference"), (8, "compiled"), (10, SHARED), (11, "compiled")]}
    assert found == {
        (8, "reference"): "pass (2)",
        (8, "compiled"): "does not apply: not installed",
        (10, SHARED): "does not apply: there are no cones",
        (11, "compiled"): "pass (1); known to fail: 0 \\| 1",
    }
    assert table.text(12, "compiled") == "**FAIL**: test_it[compiled]"
    assert table.text(12, "reference") == "does not apply: no kernel takes part"
    assert table.text(12, SHARED) == "does not apply: kernels alone"
    assert table.text(13, "compiled") == "not run"
    assert table.text(8, "Triton interpreter") == "does not apply: there are no Triton kernels yet"
    lines = table.markdown().splitlines()
    assert len(lines) == 2 + len(ENTRIES)
    assert {len(re.split(r"(?<!\\)[|]", line)) for line in lines} == {len(COLUMNS) + 4}
