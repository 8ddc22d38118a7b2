"""Runs that are stopped: by Ctrl-C, by SIGTERM, by SIGKILL. `test_campaign` does so at many more moments."""

import dataclasses
import shlex
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from nerfloom.base.machine_config import MachineConfig
from nerfloom.base.signals import Stopped, exit_status
from nerfloom.cli.session import resume, start
from nerfloom.training.checkpoint import FOLDER
from nerfloom.training.lock import LOCK
from nerfloom.training.progress import StepReport
from nerfloom.training.run import create_folder, read_run
from nerfloom.training.trainer import Trainer
from tests.faults import runs
from tests.forked import Forks
from tests.training.helpers import differences, tiny_run, tiny_trainer


@pytest.fixture
def a_terminal() -> Iterator[None]:
    """SIGHUP counts, also if the tests run under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.usefixtures("a_terminal")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_run_after_the_step_at_hand_and_it_says_how_to_go_on(
    number: signal.Signals,
    shared_tiny: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    train_step = Trainer.train_step

    def signalled(trainer: Trainer) -> StepReport:
        report = train_step(trainer)
        if report.step == 3:
            signal.raise_signal(number)
        return report

    monkeypatch.setattr(Trainer, "train_step", signalled)
    run = tiny_run("instant-ngp", shared_tiny, tmp_path / "a run", max_num_iterations=50)
    with pytest.raises(Stopped, match=r"^continue with: ns-train") as stop:
        start(run)
    assert shlex.split(str(stop.value).partition(": ")[2]) == ["ns-train", "--resume", str(run.folder)]
    assert exit_status(stop.value) == 128 + number
    said = capsys.readouterr().err
    assert f"stopped by {number.name}: step 3, " in said
    assert runs.readable_steps(run.folder) == [3]
    assert not (run.folder / "eval.json").exists()


@pytest.mark.parametrize("saving_every", [1, 1000])
def test_a_second_ctrl_c_says_what_was_saved(
    saving_every: int, shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ctrl_c_raises: None
) -> None:
    train_step = Trainer.train_step

    def signalled(trainer: Trainer) -> StepReport:
        if trainer.state.step == 3:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
        return train_step(trainer)

    monkeypatch.setattr(Trainer, "train_step", signalled)
    run = tiny_run("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=50, steps_per_save=saving_every)
    with pytest.raises(Stopped) as stop:
        start(run)
    saved = f"the last checkpoint is step-000000003.ckpt; continue with: ns-train --resume {run.folder}"
    assert str(stop.value) == "stopped at once: " + (saved if saving_every == 1 else "nothing was saved")
    assert runs.readable_steps(run.folder) == ([2, 3] if saving_every == 1 else [])
    assert exit_status(stop.value) == 130


STOPPED = """
import os, sys, threading
from collections.abc import Iterator
from pathlib import Path
from tests.patience import until

checkpoints, number = Path(sys.argv[1]), int(sys.argv[2])

def stop():
    until(lambda: list(checkpoints.glob("step-*.ckpt")))
    os.kill(os.getpid(), number)

threading.Thread(target=stop, daemon=True).start()
sys.argv = ["ns-train", *sys.argv[3:]]
from nerfloom.cli.train import main
main()
"""
"""A program that runs ns-train, and gets a signal when there is a checkpoint."""


@pytest.mark.medium
def test_a_stopped_command_exits_as_shells_expect(shared_tiny: Path, tmp_path: Path, forks: Forks) -> None:
    """The command runs in a process of its own, and saves all the time."""
    flags, folder = runs.new_run(shared_tiny, tmp_path, 100_000)
    alone = ("--machine.num-threads", 1)  # the cores are shared with other tests
    done = forks.run(STOPPED, folder / FOLDER, int(signal.SIGTERM), *flags, *alone)
    assert done.returncode == 143, done.stderr
    assert done.stderr.splitlines()[-1] == f"continue with: ns-train --resume {folder}"


@pytest.mark.medium
def test_a_killed_run_ends_with_the_same_bits(shared_tiny: Path, tmp_path: Path, forks: Forks) -> None:
    """Killed in a process of its own, which saves all the time; resumed in this one."""
    settings = {"max_num_iterations": 60, "max_eval_images": 0, "machine": MachineConfig(num_threads=1)}
    tiny_trainer("instant-ngp", shared_tiny, tmp_path / "whole", **settings).train()
    run = tiny_run("instant-ngp", shared_tiny, tmp_path / "killed", seconds_per_save=0.0, **settings)
    create_folder(run)
    done = forks.run(STOPPED, run.folder / FOLDER, int(signal.SIGKILL), "--resume", run.folder)
    assert done.returncode == -signal.SIGKILL, done.stderr
    saved = runs.readable_steps(run.folder)
    print(f"killed when {saved} were saved")
    assert 0 < saved[-1] < 60
    written = read_run(run.config_path)
    resume(dataclasses.replace(written, config=dataclasses.replace(written.config, seconds_per_save=1e9)))
    assert differences(tmp_path / "whole", run.folder) == []


def test_a_run_killed_before_its_first_checkpoint_begins_anew(
    shared_tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tiny_run("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=5, max_eval_images=0)
    create_folder(run)
    (run.folder / LOCK).write_text("process 1 on another machine")
    (run.folder / FOLDER).mkdir()
    (run.folder / FOLDER / ".step-000000002.ckpt.1.tmp").write_bytes(b"half of one")
    resume(read_run(run.config_path))
    assert "has no checkpoint" in capsys.readouterr().err
    assert [path.name for path in (run.folder / FOLDER).iterdir()] == ["step-000000005.ckpt"]
