"""The fuzzing itself: it finds readers that misbehave, and a seed reproduces every finding."""

import json
import math
import sys
from pathlib import Path

import pytest

from tests.fuzz import broken, campaign, report
from tests.fuzz.mutations import damaged
from tests.fuzz.outcome import Outcome
from tests.fuzz.trees import at, changed, places

pytest.importorskip("resource")
pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="limits of memory are those of Linux")
COUNT = 2
FOUND = {
    "refuse_in_two_lines": "of several lines",
    "raise_another_error": "KeyError",
    "take_nonsense": "a focal length of nothing",
    "leave": "SystemExit",
    "write_elsewhere": "wrote ",
    "write_where_we_are": "wrote 'here'",
    "write_to_the_data": "wrote ",
    "remove_a_file_elsewhere": "os.rename",
    "start_a_program": "subprocess.Popen",
    "use_a_shell": "os.system",
    "unpickle": "pickle.find_class",
    "take_all_memory": "MemoryError",
    "hide_that_memory_ran_out": "more memory than it may have",
    "take_more_and_more_memory": "MemoryError",
    "fill_the_disk": "OSError",
    "never_end": "SIGALRM: it took too long",
    "abort": "SIGABRT",
    "read_what_is_not_there": "SIGSEGV",
}
"""The finding for each of the broken readers."""


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory: pytest.TempPathFactory) -> list[Outcome]:
    base = tmp_path_factory.mktemp("campaign")
    return campaign.run(list(broken.READERS), base, 0, COUNT, module="tests.fuzz.broken", patience=1.5, memory=2**28)


@pytest.mark.medium
def test_every_reader_gets_every_input(outcomes: list[Outcome]) -> None:
    assert [(o.reader, o.seed) for o in outcomes] == [(name, s) for s in range(COUNT) for name in broken.READERS]
    assert set(FOUND) | {"refuse"} == set(broken.READERS)


def test_a_reader_that_refuses_in_a_line_is_left_alone(outcomes: list[Outcome]) -> None:
    own = [outcome for outcome in outcomes if outcome.reader == "refuse"]
    answers = {(outcome.kind, outcome.error, outcome.shape) for outcome in own if outcome.kind != "accepted"}
    assert answers == {("refused", "DataError", "PATH is damaged")}


@pytest.mark.parametrize("name", FOUND)
def test_a_reader_that_misbehaves_is_found(name: str, outcomes: list[Outcome]) -> None:
    own = [outcome for outcome in outcomes if outcome.reader == name]
    escapes = [outcome for outcome in own if outcome.kind == "escaped"]
    assert escapes, [str(outcome) for outcome in own]
    assert {outcome.kind for outcome in own} <= {"accepted", "escaped"}
    for outcome in escapes:
        assert FOUND[name] in f"{outcome.error}: {outcome.message}"
        assert f"--reader {name} --seed {outcome.seed} --count 1" in str(outcome)


FILES = {
    "a.json": b'{"frames": [{"file_path": "x.png", "time": 0.5}], "w": 3}',
    "b.yml": b"method: instant-ngp\nmachine:\n  seed: 3\n",
    "c.npy": b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (1,), }".ljust(128) + bytes(8),
    "d.bin": bytes(range(200)),
    "e.txt": b"# cameras\n1 PINHOLE 60 40 50 48 31 19\n",
}


def test_a_seed_makes_the_same_input_again_and_another_one_another() -> None:
    inputs = [damaged(f"reader {seed}", dict(FILES), ("*",), ("k1",)) for seed in range(200)]
    assert inputs == [damaged(f"reader {seed}", dict(FILES), ("*",), ("k1",)) for seed in range(200)]
    assert len({repr(files) for files, _ in inputs}) > 150
    assert {name[0] for _, done in inputs for name in done} == set("abcde")
    untouched = [damaged(f"reader {seed}", dict(FILES), ("a.json",), ())[0] for seed in range(50)]
    assert all(files["d.bin"] == FILES["d.bin"] for files in untouched)


def test_a_tree_is_changed_in_one_place_and_the_original_in_none() -> None:
    tree = {"a": [1, {"b": 2}], "c": (3, 4)}
    before = repr(tree)
    for where in places(tree):
        assert at(changed(tree, where, lambda _: math.pi), where) == math.pi
        assert repr(tree) == before
    assert changed(tree, ("a", 1, "b"), lambda value: value + 5) == {"a": [1, {"b": 7}], "c": (3, 4)}
    assert changed(tree, ("c", 0), lambda _: None)["c"] == (None, 4)


def test_alike_is_what_differs_in_names_and_numbers_only() -> None:
    def shape(message: str) -> str:
        return Outcome("r", 0, "refused", "DataError", message).shape

    assert shape("/tmp/a/b.json: frame 3: 'time' is 0.5") == shape("/var/c.json: frame 12: 'time' is nan")
    assert shape("a is short") != shape("a is long")


def test_counts_are_of_each_reader_and_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "LIBRARIES", ("numpy",))
    outcomes = [
        Outcome("a", 3, "accepted"),
        Outcome("a", 4, "refused", "DataError", "/x/y.json: frame 1 is none"),
        Outcome("b", 3, "escaped", "KeyError", "'w'"),
        Outcome("a", 5, "refused", "DataError", "/z.json: frame 2 is none"),
        Outcome("a", 6, "refused", "DataError", "/z.json is empty"),
    ]
    found = json.loads(json.dumps(report.as_plain(outcomes, 1.25)))
    assert found["readers"]["a"] == {
        "inputs": 4, "accepted": 1, "refused": 3, "escaped": 0, "unique_outcomes": 3, "seeds": [3, 6],
    }  # fmt: skip
    assert (found["inputs"], found["unique_outcomes"], found["escaped"]) == (5, 4, 1)
    assert [escape["reader"] for escape in found["escapes"]] == ["b"]
    assert found["libraries"]["numpy"]
    assert found["machine"]["python"]
    assert report.summary(outcomes)[0] == "a: 4 inputs, 1 accepted, 3 refused in 2 ways, 0 escaped"


def test_a_reader_that_fails_on_what_is_not_damaged_ends_the_campaign(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = tmp_path / "picky.py"
    module.write_text(
        "from tests.fuzz.reader import Reader\n"
        "def refuse(folder, scratch): raise ValueError('I take nothing')\n"
        "READERS = {'picky': Reader(lambda folder: (folder / 'a').touch(), refuse, ('*',))}\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(RuntimeError, match="I take nothing"):
        campaign.run(["picky"], tmp_path / "base", count=1, module="picky")
