"""Starts of Gaussians as a benchmark: a start that the data does not allow is a row, and a failure is a failure."""

from pathlib import Path

import pytest

from benchmarks import ablation, starts
from nerfloom.base.errors import NerfloomError


def test_a_refused_start_is_a_row_and_its_message(monkeypatch: pytest.MonkeyPatch) -> None:
    def train(data: Path, seconds: float, seed: int, target: float, switches: list[str], method: str) -> object:
        assert method == "gaussian-splatting"
        if "points" in switches:
            raise NerfloomError("a process of the benchmark failed: error: --start points: the data has no points")
        return (10.0 + seed, 30.0 + 2 * seed)

    monkeypatch.setattr(ablation, "train", train)
    rows = {row["start"]: row for row in starts.measure(Path("data"), 5.0, 2, 30.0)["rows"]}
    assert set(rows) == set(starts.STARTS)
    assert "has no points" in rows["points of a reconstruction"]["refused"]
    assert rows["field"]["seconds to the target"] == 10.5
    assert rows["field"]["test PSNR, dB"] == 31.0


def test_a_run_that_fails_ends_the_benchmark(monkeypatch: pytest.MonkeyPatch) -> None:
    def train(*_: object) -> object:
        raise NerfloomError("a process of the benchmark failed: Killed")

    monkeypatch.setattr(ablation, "train", train)
    with pytest.raises(NerfloomError, match="Killed"):
        starts.measure(Path("data"), 5.0, 1, 30.0)
