"""Jobs by Slurm: the script runs the same tasks as processes."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from nerfloom.jobs.job import Job, Resources, Step
from nerfloom.jobs.processes import Processes
from nerfloom.jobs.slurm import Slurm, script
from tests.jobs.tiny import files, job, program, write


def run_task(path: Path, number: int) -> int:
    """Run a task of the array, as Slurm does: by its number in the environment."""
    return subprocess.run(["bash", path], env={**os.environ, "SLURM_ARRAY_TASK_ID": str(number)}).returncode


def some(folder: Path) -> list[Job]:
    """A job in two steps, one with a name that a shell could take apart, and one that fails after a step."""
    two = (Step(program(write(folder / "half"))), Step(program(write(folder / "two.txt", "it's $HOME"))))
    bad = (Step(program("sys.exit(3)")), Step(program(write(folder / "bad.txt"))))
    return [job(folder, "two", *two), job(folder, "a b; 'c'"), job(folder, "bad", *bad)]


@pytest.mark.medium
def test_tasks_leave_the_files_that_processes_leave(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, other = tmp_path / "by processes", tmp_path / "by slurm"
    one.mkdir()
    failed = [each.title for each in Processes().run(some(one))]
    launcher = Slurm(other, at_once=2)
    assert launcher.run(some(other)) == {}
    assert f"sbatch '{other / 'jobs.sh'}'" in capsys.readouterr().err
    assert [run_task(other / "jobs.sh", number) for number in range(3)] == [0, 0, 3]
    assert failed == ["bad"]
    assert files(other) == files(one)
    assert set(files(one)) == {"two.txt", "a b; 'c'.txt"}
    assert (other / "logs" / "a b; 'c'.log").read_text() == "a b; 'c'\n"
    seen: list[str] = []
    launcher.run(some(other), lambda done: seen.append(done.title))
    assert seen == ["two", "a b; 'c'"]
    assert "#SBATCH --array=0-0%2" in (other / "jobs.sh").read_text()


def test_a_task_goes_on_where_an_earlier_one_was_stopped(tmp_path: Path) -> None:
    begun = tmp_path / "begun"
    first, again = program(f"{write(begun)}\nsys.exit(1)"), program(write(tmp_path / "half.txt", "resumed"))
    Slurm(tmp_path).run([job(tmp_path, "half", Step(first, begun, again))])
    assert [run_task(tmp_path / "jobs.sh", 0) for _ in range(2)] == [1, 0]
    assert files(tmp_path) == {"half.txt": "resumed"}


def test_a_task_that_cannot_begin_says_so_in_its_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Slurm's own output goes nowhere."""
    gone, here = tmp_path / "gone", tmp_path / "here"
    gone.mkdir()
    monkeypatch.chdir(gone)
    Slurm(here).run([job(here, "a")])
    monkeypatch.chdir(tmp_path)
    gone.rmdir()
    assert run_task(here / "jobs.sh", 0) == 1
    assert str(gone) in (here / "logs" / "a.log").read_text()
    gone.mkdir()
    (here / "logs" / "a.log").unlink()
    (here / "logs" / "a.log").mkdir()
    assert run_task(here / "jobs.sh", 0) == 1  # without a log, nothing runs
    assert files(here) == {}
    (here / "logs" / "a.log").rmdir()
    assert run_task(here / "jobs.sh", 0) == 0
    assert files(here) == {"a.txt": "a"}


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are Unicode there")
def test_names_need_not_be_unicode(tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"caf\xe9")
    folder.mkdir()
    Slurm(folder).run([job(folder, "a")])
    assert run_task(folder / "jobs.sh", 0) == 0
    assert files(folder) == {"a.txt": "a"}


def test_the_script_asks_for_what_the_jobs_need(tmp_path: Path) -> None:
    def asked(*resources: Resources) -> list[str]:
        jobs = [Job(f"j{n}", "", (), tmp_path, lambda: False, each) for n, each in enumerate(resources)]
        return re.findall(r"^#SBATCH (--(?:array|cpus|gpus|exclusive).*)$", script(jobs, None), re.MULTILINE)

    assert asked(Resources(2), Resources(4)) == ["--array=0-1", "--cpus-per-task=4"]
    assert asked(Resources(None, 1)) == ["--array=0-0", "--exclusive", "--gpus-per-task=1"]
