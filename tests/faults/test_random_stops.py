"""Runs that are killed or told to stop at any moment of their life, while data is read, in a step, in an evaluation,
while saving: nothing that was saved is lost, and the learning curve goes on as if nothing had happened."""

import json
import random
import signal
import time
from pathlib import Path

import pytest

from framework.training.checkpoint import list_checkpoints
from tests.cli.helpers import train
from tests.training.test_faults import assert_same_end, new_run, start

EVALUATED = ["--steps-per-eval-all-images", 20, "--max-eval-images", 1]


def curve(folder: Path) -> list[tuple[int, float]]:
    """Steps and PSNR of what a run has written of its learning curve; of a file that was cut short this fails."""
    file = folder / "learning_curve.json"
    return [(row["step"], row["psnr"]) for row in json.loads(file.read_text())] if file.exists() else []


def newest_step(folder: Path) -> int:
    return max((int(path.stem.split("-")[1]) for path in list_checkpoints(folder / "nerfstudio_models")), default=-1)


@pytest.mark.parametrize(
    "numbers",
    [
        pytest.param((signal.SIGKILL, signal.SIGTERM), id="once each"),
        pytest.param((signal.SIGKILL, signal.SIGTERM, signal.SIGKILL) * 5, id="often", marks=pytest.mark.slow),
    ],
)
def test_stopped_at_any_moment(numbers: tuple[signal.Signals, ...], shared_tiny: Path, tmp_path: Path) -> None:
    steps, moments = 160, random.Random(len(numbers))
    begun = time.monotonic()
    whole = train(shared_tiny, tmp_path / "whole", "--max-num-iterations", steps, *EVALUATED)
    life = time.monotonic() - begun
    truth = curve(whole)
    assert [step for step, _ in truth] == list(range(20, steps + 1, 20))

    unevaluated, folder = new_run(shared_tiny, tmp_path / "stopped", steps)
    flags, saved = [*unevaluated[: unevaluated.index("--max-eval-images")], *EVALUATED], -1
    for number in numbers:
        process = start(*(["--resume", folder] if (folder / "config.yml").exists() else flags))
        time.sleep(moments.uniform(0, life))
        process.send_signal(number)
        _, said = process.communicate(timeout=120)
        assert process.returncode in (0, -number), said
        print(f"{number.name}: at step {newest_step(folder)}, {len(curve(folder))} evaluations")
        assert newest_step(folder) >= saved
        saved = newest_step(folder)
        assert truth[: len(curve(folder))] == curve(folder)
    process = start(*(["--resume", folder] if (folder / "config.yml").exists() else flags))
    _, said = process.communicate(timeout=300)
    assert process.returncode == 0, said
    assert curve(folder) == truth
    seconds = [row["seconds"] for row in json.loads((folder / "learning_curve.json").read_text())]
    assert seconds == sorted(seconds)
    assert_same_end(whole, folder)
    for name in ("dataparser_transforms.json", "scene_profile.json", "summary.json", "skip_report.json"):
        assert json.loads((folder / name).read_text())
