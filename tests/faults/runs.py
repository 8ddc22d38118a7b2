"""Runs of a tiny instant-ngp in processes of their own, and their files."""

import json
import os
import subprocess
import sys
from pathlib import Path

from nerfloom.base.errors import CheckpointError
from nerfloom.training.checkpoint import FOLDER, list_checkpoints, load_checkpoint
from tests.cli.helpers import TINY_NGP
from tests.patience import PATIENCE, until

ROOT = Path(__file__).parents[2]


def new_run(data: Path, output: Path, steps: int, evaluated: int | None = None) -> tuple[list[object], Path]:
    """ns-train's arguments for a run that saves as often as it can; and its folder.

    Args:
        evaluated: steps between evaluations of one image; there is none, at the end either, if None.
    """
    flags: list[object] = [
        "instant-ngp", "--data", data, "--output-dir", output, "--timestamp", "t", *TINY_NGP,
        "--max-num-iterations", steps, "--seconds-per-save", 0.02,
        "--steps-per-eval-all-images", evaluated or steps, "--max-eval-images", 0 if evaluated is None else 1,
    ]  # fmt: skip
    return flags, output / data.name / "instant-ngp" / "t"


def start(*arguments: object, world: str | None = None) -> subprocess.Popen[str]:
    """ns-train in a process of its own.

    Args:
        world: the fault around it, a key of `tests.faults.inside.WORLDS`.
    """
    program = ["nerfloom.cli.train"] if world is None else ["tests.faults.inside", world]
    words = [sys.executable, "-m", *program, *map(str, arguments)]
    # Threads that spin while they wait make a step fifty times slower where the cores are shared.
    environment = {**os.environ, "OMP_WAIT_POLICY": "PASSIVE"}
    return subprocess.Popen(
        words, cwd=ROOT, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )


def ended(process: subprocess.Popen[str]) -> str:
    """Wait for a process's end; returns its output."""
    try:
        return process.communicate(timeout=PATIENCE)[1]
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        raise


def wait_for_checkpoint(process: subprocess.Popen[str], folder: Path) -> None:
    """Wait until a run has saved a new checkpoint, or has ended."""
    before = set(list_checkpoints(folder / FOLDER))
    until(lambda: process.poll() is not None or not set(list_checkpoints(folder / FOLDER)) <= before)


def readable_steps(folder: Path) -> list[int]:
    """Steps of a run's checkpoints that can be read, in order; while nobody writes there."""
    found = []
    for path in list_checkpoints(folder / FOLDER):
        try:
            found.append(load_checkpoint(path)["state"]["step"])
        except CheckpointError:
            continue
    return found


def curve(folder: Path) -> list[tuple[int, float]]:
    """Steps and PSNR of a run's evaluations over all images, as written; this fails for a file that was cut short.

    Evaluations of a few images follow the clock, so they differ between runs.
    """
    file = folder / "learning_curve.json"
    rows = json.loads(file.read_text()) if file.exists() else []
    return [(row["step"], row["psnr"]) for row in rows if row["full"]]
