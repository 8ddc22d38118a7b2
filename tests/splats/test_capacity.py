"""Capacity of lists of tiles: follows earlier images, does not synchronise, and counts dropped entries."""

from pathlib import Path

import pytest
import torch
from torch import Tensor

from benchmarks.operations import trainer_of
from nerfloom.kernels.splats.project import RECORD
from nerfloom.kernels.splats.tiles import TileLists
from nerfloom.splats.capacity import ENTRIES_MULTIPLE, FADED, HEADROOM, Capacity
from nerfloom.training.skipping import skip_report
from tests.training.recorded import ahead

NONE = torch.zeros(0, dtype=torch.int32)
RECORDS = torch.zeros(100, RECORD)


def lists(room: int, needed: int | None = None) -> TileLists:
    entries: Tensor | None = None if needed is None else torch.tensor(needed)
    return TileLists(NONE, torch.zeros(room, dtype=torch.int32), NONE, NONE, entries)


def test_room_is_the_most_that_images_have_needed_and_some_more(monkeypatch: pytest.MonkeyPatch) -> None:
    ahead(monkeypatch)
    capacity = Capacity()
    assert capacity.of(RECORDS, 64) is None  # nothing is known
    for entries in (50_000, 100_000, 70_000):
        capacity.note(RECORDS, 64, lists(entries))
    assert capacity.of(RECORDS, 64) is None
    capacity.read()
    given = capacity.of(RECORDS, 64)
    assert given is not None
    assert given % ENTRIES_MULTIPLE == 0
    assert HEADROOM * 100_000 <= given < HEADROOM * 100_000 + ENTRIES_MULTIPLE
    assert capacity.of(RECORDS, 65) is None  # a larger image
    assert capacity.of(RECORDS[:0], 64) is None
    capacity.note(RECORDS, 64, lists(given, given + 1000))
    capacity.read()
    assert (capacity.entries, capacity.left_out) == (220_000 + given + 1000, 1000)
    more = capacity.of(RECORDS, 64)
    assert more is not None
    assert more >= HEADROOM * (given + 1000)
    capacity.note(RECORDS, 64, lists(more, 10))
    capacity.read()
    assert abs(capacity.of(RECORDS, 64) / (FADED * more) - 1) < 2 * ENTRIES_MULTIPLE / more  # type: ignore[operator]


def test_the_cpu_asks() -> None:
    capacity = Capacity()
    capacity.note(RECORDS, 64, lists(9))
    capacity.read()
    assert capacity.of(RECORDS, 64) is None


def test_training_with_room_learns_what_it_learns_without_and_says_what_was_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bits agree while there is room; the sums of a step may be added up in another order."""
    ahead(monkeypatch)
    asking, given = (trainer_of("gaussian-splatting", tmp_path / name) for name in ("asking", "given"))
    monkeypatch.setattr(asking.model.capacity, "read", lambda: None)
    for _ in range(6):
        reports = [trainer.train_step() for trainer in (asking, given)]
        given.model.read_counts()
        assert reports[0].losses == pytest.approx(reports[1].losses, rel=1e-4)
    capacity = given.model.capacity
    assert capacity.entries > 0 == capacity.left_out
    records = given.model.columns["means"].values
    assert capacity.of(records, 8**2) is not None  # images of a quarter of the width are drawn at first
    assert not any("buffer" in rung.says for rung in skip_report(given) if rung.skipped)
    capacity.left_out = capacity.entries // 10
    assert any("buffer" in rung.says and abs(rung.skipped - 0.1) < 0.01 for rung in skip_report(given))
