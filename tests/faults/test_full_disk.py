"""A disk that is full at any moment: existing files stay, failed writes are reported, the run goes on.

Checkpoints are tested with their own (`tests/training`), decoded pixels with theirs (`tests/test_cache.py`).
"""

import errno
import json
import os
import stat
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import pytest
import torch

from nerfloom.base.atomic import write_atomically
from nerfloom.base.errors import CheckpointError, ConfigError
from nerfloom.cli import evaluate as eval_command
from nerfloom.cli.job_flags import JobFlags
from nerfloom.cli.session import resume
from nerfloom.cli.session import start as start_session
from nerfloom.evaluation.evaluator import evaluate
from nerfloom.evaluation.images import write_image
from nerfloom.jobs.job import Step
from nerfloom.training.checkpoint import FOLDER
from nerfloom.training.run import create_folder, read_run, write_report
from tests.conftest import Refused
from tests.faults.conftest import Disk
from tests.faults.runs import ended, readable_steps, start
from tests.jobs.tiny import files, job, program
from tests.training.helpers import tiny_run, tiny_trainer


def full(*_: Any, **__: Any) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


class FullFile:
    """A file that takes half of each write."""

    def __init__(self, file: Any) -> None:
        self.file = file

    def write(self, content: bytes) -> None:
        self.file.write(content[: len(content) // 2])
        self.file.flush()
        full()


@pytest.mark.parametrize("when", ["writing", "flushing", "renaming"])
def test_what_was_there_stays_and_no_half_is_left(when: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"before")
    if when != "writing":
        monkeypatch.setattr(os, "fsync" if when == "flushing" else "replace", full)
    with pytest.raises(OSError, match="No space left"):
        write_atomically(path, lambda file: (FullFile(file) if when == "writing" else file).write(b"after!"))
    assert path.read_bytes() == b"before"
    assert [file.name for file in tmp_path.iterdir()] == ["file"]


def test_names_reach_the_disk_before_older_files_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    events: list[str] = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda opened: (events.append(_kind(opened)), fsync(opened))[1])
    monkeypatch.setattr(os, "replace", lambda *paths: (events.append("renamed"), replace(*paths))[1])
    write_atomically(tmp_path / "file", lambda file: file.write(b"content"))
    assert events == ["file", "renamed", *(["folder"] if os.name == "posix" else [])]


def _kind(opened: int) -> str:
    return "folder" if stat.S_ISDIR(os.fstat(opened).st_mode) else "file"


def test_no_room_for_the_settings(shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The folder is then as free as before."""
    a_run = tiny_run("instant-ngp", shared_tiny, tmp_path / "run")
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(ConfigError, match=r"cannot write the run's folder .*: No space left on device"):
            create_folder(a_run)
    assert list((tmp_path / "run").iterdir()) == []
    create_folder(a_run)
    assert read_run(a_run.config_path).method == "instant-ngp"


def test_a_report_that_cannot_be_written_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_report(tmp_path / "curve.json", [1])
    monkeypatch.setattr(os, "fsync", full)
    write_report(tmp_path / "curve.json", [1, 2])
    said = capsys.readouterr().err
    assert f"warning: cannot write {tmp_path / 'curve.json'}: No space left on device" in said
    assert json.loads((tmp_path / "curve.json").read_text()) == [1]


def test_half_a_picture_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def half(path: Path, image: Any, **_: Any) -> None:
        path.write_bytes(b"\x89PNG")
        full()

    monkeypatch.setattr(iio, "imwrite", half)
    with pytest.raises(OSError, match="No space left"):
        write_image(tmp_path / "a.png", torch.zeros(4, 4, 3))
    assert list(tmp_path.iterdir()) == []


def test_pictures_cost_no_figures(shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", evaluated=True)
    assert trainer.eval_set is not None
    with_room = evaluate(trainer.model, trainer.eval_set, pictures=tmp_path / "room")
    assert with_room.pictures_note is None
    assert len(list((tmp_path / "room").iterdir())) == 3 * len(trainer.eval_set)
    monkeypatch.setattr(iio, "imwrite", full)
    found = evaluate(trainer.model, trainer.eval_set, pictures=tmp_path / "full")
    assert found.pictures_note == f"cannot write pictures to {tmp_path / 'full'}: No space left on device"
    assert found.results["psnr"] == with_room.results["psnr"]
    assert len(found.per_image) == len(trainer.eval_set)


def test_a_session_ends_with_its_figures(
    shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(iio, "imwrite", full)
    start_session(tiny_run("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=2))
    said = capsys.readouterr().err
    assert "warning: cannot write pictures to " in said
    assert "test: PSNR " in said
    assert json.loads((tmp_path / "run" / "eval.json").read_text())["results"]["num_images"] == 3


def test_an_evaluation_that_cannot_be_written_is_refused_before_it_begins(
    shared_tiny: Path, tmp_path: Path, refused: Refused
) -> None:
    tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=2, max_eval_images=0).train()
    (tmp_path / "file").write_text("in the way")
    config = ("--load-config", tmp_path / "run" / "config.yml", "--device-type", "cpu")
    pictures = tmp_path / "file" / "pictures"
    said = refused(eval_command.main, *config, "--render-output-path", pictures)
    assert said.startswith(f"error: cannot write pictures to {pictures}: ")
    said = refused(eval_command.main, *config, "--output-path", tmp_path / "file" / "eval.json")
    assert said.startswith(f"error: cannot write {tmp_path / 'file' / 'eval.json'}: ")
    assert not (tmp_path / "run" / "eval.json").exists()


def test_photographs_with_long_names_have_pictures(tiny: Path, tmp_path: Path) -> None:
    """Names of 245 bytes are as long as most systems allow with an ending, and pictures' are longer."""
    content = json.loads((tiny / "transforms_val.json").read_text())
    for index, frame in enumerate(content["frames"]):
        name = f"{index}" + 120 * "\u00e9" + ".png"
        (tiny / f"{frame['file_path']}.png").rename(tiny / name)
        frame["file_path"] = name
    (tiny / "transforms_val.json").write_text(json.dumps(content))
    trainer = tiny_trainer("instant-ngp", tiny, tmp_path / "run", evaluated=True)
    assert trainer.eval_set is not None
    found = evaluate(trainer.model, trainer.eval_set, pictures=tmp_path / "pictures")
    assert found.pictures_note is None
    assert len(list((tmp_path / "pictures").iterdir())) == 3 * len(trainer.eval_set)


def test_a_disk_that_fills_up_while_training(shared_tiny: Path, tmp_path: Path, disk: Disk) -> None:
    """A real disk, with room for 1.5 checkpoints. The run trains to its end, keeps what it has, and is resumed."""
    one = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "one", max_num_iterations=1, max_eval_images=0).train()
    disk(f"size={one.checkpoint.stat().st_size * 3 // 2 // 1024 + 64}k")
    settings = {"max_num_iterations": 12, "steps_per_save": 4, "max_eval_images": 0}
    run = tiny_run("instant-ngp", shared_tiny, tmp_path / "disk" / "run", **settings)
    with pytest.raises(CheckpointError, match="No space left on device"):
        start_session(run)
    assert [path.name for path in (run.folder / FOLDER).iterdir()] == ["step-000000004.ckpt"]
    assert readable_steps(run.folder) == [4]
    disk("size=64m")
    resume(run)
    assert readable_steps(run.folder) == [8, 12]


@pytest.mark.slow
def test_files_that_may_not_grow(shared_tiny: Path, tmp_path: Path) -> None:
    """Where no disk may be mounted: the system itself refuses to write more to a file."""
    folder = tmp_path / "run"
    tiny_trainer("instant-ngp", shared_tiny, folder, max_num_iterations=4, max_eval_images=0).train()
    process = start("--resume", folder, "--max-num-iterations", 12, "--steps-per-save", 4, world="full disk")
    said = ended(process)
    assert process.returncode == 1
    assert "Traceback" not in said
    assert said.strip().splitlines()[-1].startswith("error: cannot write ")
    assert said.count("File too large; earlier checkpoints are unchanged") == 3  # at 8, at 12, and at the end
    assert [path.name for path in (folder / FOLDER).iterdir()] == ["step-000000004.ckpt"]
    assert readable_steps(folder) == [4]


def test_a_disk_that_is_full_from_the_start(shared_tiny: Path, tmp_path: Path, disk: Disk) -> None:
    disk("size=64k")
    (tmp_path / "disk" / "rubbish").write_bytes(bytes(50_000))
    with pytest.raises(OSError, match="No space"):
        (tmp_path / "disk" / "more").write_bytes(bytes(10**6))
    a_run = tiny_run("instant-ngp", shared_tiny, tmp_path / "disk" / "run")
    with pytest.raises(ConfigError, match=r"cannot write the run's folder .*: No space left on device"):
        create_folder(a_run)


@pytest.mark.parametrize("launcher", ["processes", pytest.param("ray", marks=pytest.mark.slow)])
def test_jobs_on_a_disk_that_fills_up(launcher: Any, tmp_path: Path, disk: Disk) -> None:
    """A real disk, too small for one of the results. What was finished stays, and the same call finishes the rest."""
    if launcher == "ray":
        pytest.importorskip("ray", reason="Ray is not installed: pip install ray")
    folder = tmp_path / "disk"
    half, result = folder / "large.part", folder / "large.txt"
    large = program(
        f"pathlib.Path({str(half)!r}).write_text(300_000 * 'x')\nos.replace({str(half)!r}, {str(result)!r})"
    )
    jobs = [job(folder, "first"), job(folder, "large", Step(large)), job(folder, "last")]
    disk("size=200k")
    failures = JobFlags(launcher=launcher, jobs=1).chosen_launcher(folder).run(jobs)
    assert "large" in [failed.title for failed in failures]
    assert files(folder)["first.txt"] == "first"
    assert not result.exists()
    kept = (folder / "first.txt").stat().st_mtime_ns
    disk("size=64m")
    assert JobFlags(launcher=launcher, jobs=1).chosen_launcher(folder).run(jobs) == {}
    assert files(folder) == {"first.txt": "first", "large.txt": 300_000 * "x", "last.txt": "last"}
    assert (folder / "first.txt").stat().st_mtime_ns == kept
