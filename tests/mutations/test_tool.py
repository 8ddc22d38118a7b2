"""The tool that plants bugs: its list is not stale, what it plants is gone afterwards, and it asks the right tests."""

from pathlib import Path

import pytest

from tests.mutations import campaign
from tests.mutations.bug import Bug, all_bugs, faults_of
from tests.mutations.copy import ROOT, make_copy
from tests.mutations.reach import Reach, digest, lines_to_ask

SOURCE = '''LIMIT = 3


def first(value, most=LIMIT):
    """Something."""
    if value > most:
        return most
    return sum(
        [value, 1]
    )


def second(value):
    return value - 1
'''


def bug(old: str, new: str, name: str = "it") -> Bug:
    return Bug(name, "kind", "framework/part.py", old, new, "nothing good")


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    (tmp_path / "framework" / "__pycache__").mkdir(parents=True)
    (tmp_path / "framework" / "part.py").write_text(SOURCE)
    return tmp_path


@pytest.mark.medium
def test_every_bug_of_the_list_can_be_planted() -> None:
    assert faults_of(all_bugs(), ROOT) == []
    assert len(all_bugs()) > 60
    assert all(bug.means and bug.kind for bug in all_bugs())


def test_what_cannot_be_planted_is_named(tree: Path) -> None:
    cases = {
        "no longer": "has its old text 0 times",
        "value": "has its old text 5 times",
        "LIMIT = 3": "leaves framework/part.py as it is",
        "value > most": "is no Python",
    }
    news = {"LIMIT = 3": "LIMIT  =  3", "value > most": "value >"}
    for old, words in cases.items():
        (found,) = faults_of([bug(old, news.get(old, "x"))], tree)
        assert words in found
    both = bug("LIMIT = 3", "LIMIT = 4")
    assert faults_of([both, both], tree) == ["it: two bugs have this name"]
    assert faults_of([Bug("gone", "", "framework/no.py", "a", "b", "")], tree) == [
        "gone: there is no file framework/no.py"
    ]


def test_a_bug_is_there_only_while_it_is_planted(tree: Path) -> None:
    file, stale = tree / "framework" / "part.py", tree / "framework" / "__pycache__" / "part.cpython-311.pyc"
    stale.write_bytes(b"as it was")
    with bug("value - 1", "value + 1").planted(tree):
        assert file.read_text() == SOURCE.replace("value - 1", "value + 1")
        assert not stale.exists()
    assert file.read_text() == SOURCE


@pytest.mark.parametrize(
    ("old", "lines"),
    [
        ("LIMIT = 3", None),
        ("most=LIMIT", {5, 6, 7, 8, 9, 10}),
        ("value > most", {6}),
        ("return most", {7}),
        ("[value, 1]", {8, 9, 10}),
        ("value - 1", {14}),
    ],
)
def test_tests_are_asked_that_run_the_statement(tree: Path, old: str, lines: set[int] | None) -> None:
    assert lines_to_ask(bug(old, "x"), tree) == lines


def test_short_tests_come_first_and_those_of_a_shared_fixture_together(tree: Path) -> None:
    made = "module fixture b.py::made"
    reach = Reach(
        {"framework/part.py": digest(tree / "framework" / "part.py")},
        ["a.py::long", "a.py::short", made, "a.py::elsewhere"],
        {"framework/part.py": {"6": [0, 1, 2], "14": [3]}},
        {"a.py::long": [], "b.py::one": [made], "a.py::short": [], "b.py::other": [made], "a.py::elsewhere": []},
        {"a.py::long": 9.0, "b.py::one": 1.0, "a.py::short": 0.1, "b.py::other": 1.0, "a.py::elsewhere": 0.1},
    )
    inside = bug("value > most", "value < most")
    assert reach.tests(inside, tree) == ["a.py::short", "b.py::one", "b.py::other", "a.py::long"]
    assert set(reach.tests(bug("LIMIT = 3", "LIMIT = 4"), tree)) == set(reach.seconds)
    (tree / "framework" / "part.py").write_text("# moved\n" + SOURCE)
    assert set(reach.tests(inside, tree)) == set(reach.seconds)


@pytest.mark.slow
def test_a_bug_is_noticed_and_what_is_none_is_not(tmp_path: Path) -> None:
    """In a copy, which alone is imported there; the tree itself is not touched."""
    file = "framework/geometry/bounds.py"
    before = (ROOT / file).read_text()
    old = "(positions - box[0]) / (box[1] - box[0])"
    wrong, right = (Bug(name, "kind", file, old, new, "") for name, new in (("w", "positions"), ("r", old + " + 0.0")))
    names = ["tests/test_bounds.py"]
    reach = campaign.record(make_copy(tmp_path / "whole"), tmp_path / "record", names, 1)
    assert reach.seconds.keys()
    assert {name.partition("::")[0] for name in reach.tests(wrong, ROOT)} == set(names)
    found = {result.bug.name: result.noticed_by for result in campaign.run([wrong, right], reach, tmp_path, 1)}
    assert found["r"] is None
    assert found["w"] is not None
    assert found["w"].startswith("tests/test_bounds.py::")
    assert (ROOT / file).read_text() == before
