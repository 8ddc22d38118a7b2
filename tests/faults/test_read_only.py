"""Folders that may not be written to: refused in a line before anything is spent on them."""

from collections.abc import Callable
from pathlib import Path

import pytest

from nerfloom.cli import evaluate as eval_command
from nerfloom.cli.train import main
from nerfloom.training.lock import LOCK
from tests.cli.helpers import TINY_NGP
from tests.conftest import Refused
from tests.faults.conftest import Disk
from tests.training.helpers import tiny_trainer

ReadOnly = Callable[[Path], None]


def assert_all_refused(data: Path, folder: Path, a_run: Path, refused: Refused) -> None:
    """Check that starting, resuming and evaluating a run in a folder are refused."""
    flags = ("--data", data, "--output-dir", folder, "--timestamp", "t", *TINY_NGP)
    assert refused(main, "instant-ngp", *flags).startswith(f"error: cannot write the run's folder {folder}")
    assert f"cannot write the run's folder {a_run}" in refused(main, "--resume", a_run)
    said = refused(eval_command.main, "--load-config", a_run / "config.yml", "--device-type", "cpu")
    assert f"cannot write {a_run / 'eval.json'}" in said


def held(folder: Path) -> dict[str, bytes]:
    """Every file below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("locked_before", [False, True])
def test_a_folder_without_the_right(
    locked_before: bool, shared_tiny: Path, tmp_path: Path, read_only: ReadOnly, refused: Refused
) -> None:
    """The file of a lock of before may be written, but nothing else."""
    a_run = tmp_path / "outputs" / "run"
    tiny_trainer("instant-ngp", shared_tiny, a_run, max_num_iterations=1, max_eval_images=0).train()
    if locked_before:
        (a_run / LOCK).touch()
    read_only(a_run)
    read_only(tmp_path / "outputs")
    before = held(tmp_path / "outputs")
    assert_all_refused(shared_tiny, tmp_path / "outputs", a_run, refused)
    assert held(tmp_path / "outputs") == before


def test_a_disk_that_is_read_only(shared_tiny: Path, tmp_path: Path, disk: Disk, refused: Refused) -> None:
    a_run = tmp_path / "disk" / "run"
    tiny_trainer("instant-ngp", shared_tiny, a_run, max_num_iterations=1, max_eval_images=0).train()
    disk("ro")
    before = held(tmp_path / "disk")
    assert_all_refused(shared_tiny, tmp_path / "disk", a_run, refused)
    assert held(tmp_path / "disk") == before


def test_a_disk_that_becomes_read_only(
    shared_tiny: Path, tmp_path: Path, disk: Disk, capsys: pytest.CaptureFixture[str]
) -> None:
    """Linux does so if a disk fails: the run in memory goes on, and can be saved afterwards."""
    settings = {"max_num_iterations": 6, "steps_per_save": 2, "max_eval_images": 0}
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "disk" / "run", **settings)
    original, done = trainer.train_step, []

    def step() -> object:
        report = original()
        done.append(report)
        if len(done) == 3:
            disk("ro")
        if len(done) == 5:
            disk("rw")
        return report

    trainer.train_step = step  # type: ignore[method-assign,assignment]
    trainer.train()
    said = capsys.readouterr().err
    assert said.count("earlier checkpoints are unchanged") == 1  # at step 4
    assert "Read-only file system" in said
    names = sorted(path.name for path in trainer.checkpoint_folder.iterdir())
    assert names == ["step-000000002.ckpt", "step-000000006.ckpt"]
