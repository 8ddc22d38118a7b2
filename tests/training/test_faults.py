"""Runs that are stopped: by Ctrl-C, by SIGTERM, by SIGKILL at any moment."""

import random
import signal
import subprocess
import time
from pathlib import Path

import pytest
import torch

from framework.training.checkpoint import list_checkpoints, load_newest
from tests.cli.helpers import TINY_NGP, command, train
from tests.training.helpers import tiny_trainer

STEPS = 20_000


def start(*arguments: object) -> subprocess.Popen[str]:
    words = [command("ns-train"), *map(str, arguments)]
    return subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def wait_for_checkpoint(process: subprocess.Popen[str], folder: Path, after: int = -1) -> int:
    """Wait until the run has saved a later step than `after`; returns the step."""
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        assert process.poll() is None, f"the run ended by itself: {process.stderr.read() if process.stderr else ''}"
        steps = [int(path.stem.split("-")[1]) for path in list_checkpoints(folder / "nerfstudio_models")]
        if steps and max(steps) > after:
            return max(steps)
        time.sleep(0.005)
    raise AssertionError("no checkpoint within two minutes")


def new_run(data: Path, output: Path, steps: int) -> tuple[list[object], Path]:
    flags: list[object] = [
        "instant-ngp", "--data", data, "--output-dir", output, "--timestamp", "t", *TINY_NGP,
        "--max-num-iterations", steps, "--seconds-per-save", 0.02, "--max-eval-images", 0,
    ]  # fmt: skip
    return flags, output / data.name / "instant-ngp" / "t"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_saves_and_says_where(number: signal.Signals, shared_tiny: Path, tmp_path: Path) -> None:
    flags, folder = new_run(shared_tiny, tmp_path, STEPS)
    process = start(*flags)
    wait_for_checkpoint(process, folder)
    process.send_signal(number)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 0
    assert f"stopped by {number.name}" in said
    assert f"continue with: ns-train --resume {folder}" in said
    saved = load_newest(folder / "nerfstudio_models")
    assert saved is not None
    assert 0 < saved["state"]["step"] < STEPS


def kill_and_resume(data: Path, output: Path, kills: int, steps: int, seed: int = 0) -> Path:
    """Train to the end through `kills` SIGKILLs at random moments, one in each stretch of the run."""
    moments = random.Random(seed)
    flags, folder = new_run(data, output, steps)
    process = start(*flags)
    step = -1
    for kill in range(kills):
        earliest = int(steps * (kill + moments.random()) / (kills + 1))
        step = wait_for_checkpoint(process, folder, after=max(step, earliest))
        time.sleep(moments.uniform(0, 0.05))
        process.kill()
        process.communicate()
        saved = load_newest(folder / "nerfstudio_models")
        assert saved is not None
        print(f"killed at or after step {saved['state']['step']}")
        assert saved["state"]["step"] < steps, "the run ended before it could be killed"
        process = start("--resume", folder)
    _, said = process.communicate(timeout=300)
    assert process.returncode == 0, said
    return folder


def assert_same_end(first: Path, second: Path) -> None:
    a, b = (load_newest(folder / "nerfstudio_models") for folder in (first, second))
    assert a is not None
    assert b is not None
    assert a["state"]["step"] == b["state"]["step"]
    for name, value in a["model"].items():
        assert torch.equal(value, b["model"][name]), name
    for index, state in a["optimizer"]["state"].items():
        for name, value in state.items():
            assert torch.equal(value, b["optimizer"]["state"][index][name]), name
    print(f"{len(a['model'])} tensors of the model and Adam's are equal bit for bit at step {a['state']['step']}")


@pytest.mark.parametrize(("kills", "steps"), [(2, 150), pytest.param(20, 1500, marks=pytest.mark.slow)])
def test_killed_runs_end_with_the_same_bits(kills: int, steps: int, shared_tiny: Path, tmp_path: Path) -> None:
    whole = train(shared_tiny, tmp_path / "whole", "--max-num-iterations", steps, "--max-eval-images", 0)
    assert_same_end(whole, kill_and_resume(shared_tiny, tmp_path / "killed", kills, steps))


@pytest.mark.slow
def test_killed_before_the_first_checkpoint(shared_tiny: Path, tmp_path: Path) -> None:
    flags, folder = new_run(shared_tiny, tmp_path, 5)
    process = start(*flags)
    while not (folder / "config.yml").is_file():
        assert process.poll() is None
        time.sleep(0.005)
    process.kill()
    process.communicate()
    for checkpoint in list_checkpoints(folder / "nerfstudio_models"):
        checkpoint.unlink()  # should it have come so far
    process = start("--resume", folder)
    _, said = process.communicate(timeout=120)
    assert process.returncode == 0
    assert "has no checkpoint: starting from the beginning" in said
    saved = load_newest(folder / "nerfstudio_models")
    assert saved is not None
    assert saved["state"]["step"] == 5


def test_a_really_full_disk_says_why_and_spares_the_old_checkpoint(shared_tiny: Path, tmp_path: Path) -> None:
    """Files may not grow beyond 20 kB: the operating system itself refuses to write."""
    resource = pytest.importorskip("resource")
    folder = tmp_path / "run"
    tiny_trainer("instant-ngp", shared_tiny, folder, max_num_iterations=4, max_eval_images=0).train()
    flags = ["--max-num-iterations", "12", "--steps-per-save", "4"]
    done = subprocess.run(
        [command("ns-train"), "--resume", str(folder), *flags],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000)),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert done.stderr.strip().splitlines()[-1].startswith("error: cannot write ")
    assert [path.name for path in (folder / "nerfstudio_models").iterdir()] == ["step-000000004.ckpt"]
    assert done.stderr.count("earlier checkpoints stand") == 3  # at 8, at 12, and at the end: it went on
    saved = load_newest(folder / "nerfstudio_models")
    assert saved is not None
    assert saved["state"]["step"] == 4
    assert "File too large" in done.stderr
