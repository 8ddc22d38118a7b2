"""Room for lists of tiles: as much as images have needed, no wait for it, and what has no room is counted."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from benchmarks.operations import trainer_of
from nerfloom.kernels.splats.tiles import TileLists
from nerfloom.splats.capacity import FADED, HEADROOM, PIECE, Room
from nerfloom.training.skipping import skip_report
from tests.training.recorded import ahead

NONE = torch.zeros(0, dtype=torch.int32)
RECORDS = torch.zeros(100, 16)


def lists(room: int, needed: int | None = None) -> TileLists:
    entries: Tensor | None = None if needed is None else torch.tensor(needed)
    return TileLists(NONE, torch.zeros(room, dtype=torch.int32), NONE, NONE, entries)


def test_room_is_the_most_that_images_have_needed_and_some_more(monkeypatch: pytest.MonkeyPatch) -> None:
    ahead(monkeypatch)
    room = Room()
    assert room.of(RECORDS, 64) is None  # nothing is known
    for entries in (50_000, 100_000, 70_000):
        room.note(RECORDS, 64, lists(entries))
    assert room.of(RECORDS, 64) is None
    room.read()
    given = room.of(RECORDS, 64)
    assert given is not None
    assert given % PIECE == 0
    assert HEADROOM * 100_000 <= given < HEADROOM * 100_000 + PIECE
    assert room.of(RECORDS, 65) is None  # a larger image
    assert room.of(RECORDS[:0], 64) is None
    room.note(RECORDS, 64, lists(given, given + 1000))
    room.read()
    assert (room.entries, room.left_out) == (220_000 + given + 1000, 1000)
    more = room.of(RECORDS, 64)
    assert more is not None
    assert more >= HEADROOM * (given + 1000)
    room.note(RECORDS, 64, lists(more, 10))
    room.read()
    assert abs(room.of(RECORDS, 64) / (FADED * more) - 1) < 2 * PIECE / more  # type: ignore[operator]


def test_the_cpu_asks() -> None:
    room = Room()
    room.note(RECORDS, 64, lists(9))
    room.read()
    assert room.of(RECORDS, 64) is None


def test_training_with_room_learns_what_it_learns_without_and_says_what_was_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As long as there is enough; the sums of a step may be added up in another order."""
    ahead(monkeypatch)
    asking, given = (trainer_of("gaussian-splatting", tmp_path / name) for name in ("asking", "given"))
    monkeypatch.setattr(asking.model.room, "read", lambda: None)
    for _ in range(6):
        reports = [trainer.train_step() for trainer in (asking, given)]
        given.model.read_counts()
        assert reports[0].losses == pytest.approx(reports[1].losses, rel=1e-4)
    room = given.model.room
    assert room.entries > 0 == room.left_out
    assert room.of(given.model.means.values, 8**2) is not None  # images of a quarter of the width are drawn at first
    assert not any("room" in rung.says for rung in skip_report(given) if rung.skipped)
    room.left_out = room.entries // 10
    assert any("room" in rung.says and abs(rung.skipped - 0.1) < 0.01 for rung in skip_report(given))
