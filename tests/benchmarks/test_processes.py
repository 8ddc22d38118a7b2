"""python -m benchmarks processes: three kinds of runs; torchrun starts two of them."""

import json
from pathlib import Path

import pytest

from benchmarks import processes


def test_each_kind_is_started_with_its_processes_and_its_share_of_the_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    commands = []

    def output_of(command: list[str]) -> str:
        commands.append(command)
        run = Path(command[command.index("--output-dir") + 1]) / "data" / "instant-ngp" / "t"
        run.mkdir(parents=True)
        (run / "config.yml").touch()
        (run / "learning_curve.json").write_text(json.dumps([{"seconds": 2.0, "psnr": 20.0, "full": False}]))
        (run / "summary.json").write_text(json.dumps({"steps": 7, "rays": 99}))
        (run / "eval.json").write_text(json.dumps({"results": {"psnr": 21.5}}))
        return ""

    monkeypatch.setattr(processes, "output_of", output_of)
    rows = processes.measure(Path("data"), 4, 5.0, 2, 1000, (10.0, 30.0))["runs"]
    started = [
        (command[command.index("--nproc-per-node") + 1] if "--nproc-per-node" in command else "1", command)
        for command in commands
    ]
    batches = [(count, command[command.index("--samples-per-batch") + 1]) for count, command in started]
    assert batches == [("1", "1000"), ("4", "1000"), ("4", "250")] * 2
    assert all("nerfloom.cli.train" in command for command in commands)
    assert [row["seed"] for row in rows] == [0, 0, 0, 1, 1, 1]
    assert {row["seconds to 10 dB"] for row in rows} == {1.0}
    assert {row["seconds to 30 dB"] for row in rows} == {None}
    assert rows[0]["curve"] == [(2.0, 20.0)]
