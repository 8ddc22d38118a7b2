"""A mutant is one change of one function, planted at import; all that are listed fit the source as it is."""

import ast
import functools
import importlib
import subprocess
import sys
from collections import Counter
from pathlib import Path
from types import ModuleType

import pytest

from tests.mutants import all_mutants
from tests.mutants.mutant import ROOT, Mutant, NotPlantable, Planter, source_of

TOY = """
def first(value, most=3):
    if value > most:
        return most
    return max(min(value, most), 0) + 1

class Kept:
    def add(self, value):
        self.values = [*self.values, value]
        self.values.sort()

    values = [2.0, 1.0]
"""


def mutant(function: str, old: str, new: str, which: int | None = None) -> Mutant:
    return Mutant("it", function, old, new, "nothing good", "test_it.py::test_it", "mutants_toy", which)


@pytest.mark.parametrize(
    ("change", "first", "values"),
    [
        (mutant("first", "A > B", "A >= B"), (1, 3, 3), [1.0, 1.5, 2.0]),
        (mutant("first", "max(A, 0)", "A"), (-1, 4, 3), [1.0, 1.5, 2.0]),
        (mutant("first", "A > B", "not A > B"), (3, 3, 4), [1.0, 1.5, 2.0]),
        (mutant("first", "most", "2", which=1), (1, 4, 2), [1.0, 1.5, 2.0]),
        (mutant("Kept.add", "self.values.sort()", "pass"), (1, 4, 3), [2.0, 1.0, 1.5]),
        (mutant("Kept.add", "[*A, B]", "[B, *A]"), (1, 4, 3), [1.0, 1.5, 2.0]),
        (mutant("Kept", "2.0", "-2.0"), (1, 4, 3), [-2.0, 1.0, 1.5]),
    ],
    ids=lambda it: it.old if isinstance(it, Mutant) else "",
)
def test_a_module_is_imported_with_the_change(
    change: Mutant, first: tuple[int, ...], values: list[float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "mutants_toy.py"
    file.write_text(TOY)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "meta_path", sys.meta_path.copy())

    def toy() -> ModuleType:
        monkeypatch.delitem(sys.modules, "mutants_toy", raising=False)
        return importlib.import_module("mutants_toy")

    assert [toy().first(value) for value in (-2, 3, 4)] == [1, 4, 3]
    with pytest.raises(NotPlantable, match="imported already"):
        Planter(change).plant()
    monkeypatch.delitem(sys.modules, "mutants_toy")
    Planter(change).plant()
    changed = toy()
    assert tuple(changed.first(value) for value in (-2, 3, 4)) == first
    kept = changed.Kept()
    kept.add(1.5)
    assert kept.values == values
    assert file.read_text() == TOY


def test_layout_and_names_under_a_letter_do_not_matter() -> None:
    change = mutant("first", "max(A, 0)", "A")
    other = TOY.replace("max(min(value, most), 0)", "max(\n        min(number, most),  # at most\n        0,\n    )")
    wanted = TOY.replace("max(min(value, most), 0)", "min(number, most)")
    assert ast.dump(change.tree(other)) == ast.dump(ast.parse(wanted))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (mutant("second", "A > B", "A < B"), "no second"),
        (mutant("first", "A < B", "A > B"), "matches 0 places"),
        (mutant("first", "most", "2"), "matches 3 places; say which"),
        (mutant("first", "most", "2", which=3), "matches 3 places"),
        (mutant("first", "A > B", "A > most"), "changes nothing"),
    ],
)
def test_what_does_not_fit_is_named(change: Mutant, words: str) -> None:
    with pytest.raises(NotPlantable, match=words):
        change.tree(TOY)


def test_all_that_are_listed_fit_the_source_and_name_a_test() -> None:
    mutants = all_mutants()
    assert [name for name, count in Counter(one.name for one in mutants).items() if count > 1] == []
    parsed = functools.cache(lambda module: ast.parse(source_of(module).read_text("utf-8")))
    text = functools.cache(lambda file: (ROOT / "tests" / file).read_text("utf-8"))
    faults = []
    for one in mutants:
        file, _, name = one.test.partition("::")
        if f"def {name}(" not in text(file):
            faults.append(f"{one.name}: there is no test {one.test}")
        try:
            one.change(parsed(one.module))
        except NotPlantable as error:
            faults.append(str(error))
    assert faults == []


@pytest.mark.slow
def test_one_is_killed_and_one_that_is_no_bug_survives() -> None:
    code = """
from dataclasses import replace
from tests.mutants import all_mutants
from tests.mutants.__main__ import preload, tried

preload()
bug = next(one for one in all_mutants() if one.name == "slab-inside")
mutants = [bug, replace(bug, new="A.clamp_min(0)"), replace(bug, old="A.clamp(max=0)")]
print([one.verdict for one in tried([(one, [one.test]) for one in mutants], 1)])
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("['killed', 'survived', \"slab-inside: 'A.clamp(max=0)' matches 0 places")
