"""Jobs as processes of this machine: order, failures, interruptions, and kept files."""

import errno
import json
import os
import shlex
import signal
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.cli.job_flags import JobFlags
from nerfloom.jobs.job import Job, Resources, Step
from nerfloom.jobs.processes import Processes, places_for
from tests.jobs.tiny import driver, files, job, long_job, program, write
from tests.patience import until


def test_jobs_run_in_order_and_finished_ones_are_only_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    jobs = [job(tmp_path, name) for name in ("a", "b", "c")]
    (tmp_path / "b.txt").write_text("from earlier")
    seen: list[str] = []
    assert Processes().run(jobs, lambda done: seen.append(done.title)) == {}
    assert sorted(seen) == ["a", "b", "c"]
    assert files(tmp_path) == {"a.txt": "a", "b.txt": "from earlier", "c.txt": "c"}
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["[2/3] b: already finished", "[1/3] a: a moment", "[3/3] c: a moment"]
    command, output = (tmp_path / "logs" / "a.log").read_text().splitlines()
    assert command.startswith("$ ")
    assert output == "a"
    assert not (tmp_path / "logs" / "b.log").exists()


def test_failures_name_the_reason_and_the_others_go_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bad = job(tmp_path, "bad", code="sys.exit('error: its disk is on fire')")
    killed = job(tmp_path, "killed", code="os.kill(os.getpid(), signal.SIGKILL)")
    missing = job(tmp_path, "missing", Step(("/no/such/program",)))
    empty = job(tmp_path, "empty", Step(program("pass")))
    late = job(tmp_path, "late", Step(program("sys.exit(3)")), Step(program(write(tmp_path / "late.txt"))))
    failures = Processes().run([bad, killed, missing, empty, late, job(tmp_path, "good")])
    assert {failed.title: failure.reason for failed, failure in failures.items()} == {
        "bad": "its disk is on fire",
        "killed": "ended by SIGKILL (too little memory?)",
        "missing": "/no/such/program: No such file or directory",
        "empty": "it ended without a result",
        "late": "exit status 3",
    }
    assert files(tmp_path) == {"good.txt": "good"}
    assert f"bad failed: its disk is on fire (full output: {bad.log})" in capsys.readouterr().err


def test_a_killed_job_goes_on_where_it_was(tmp_path: Path) -> None:
    begun = tmp_path / "begun"
    first = program(f"{write(begun)}\nos.kill(os.getpid(), signal.SIGKILL)")
    jobs = [job(tmp_path, "whole"), job(tmp_path, "half", Step(first, begun, program(write(tmp_path / "half.txt"))))]
    assert [failed.title for failed in Processes().run(jobs)] == ["half"]
    whole = (tmp_path / "whole.txt").stat().st_mtime_ns
    assert Processes().run(jobs) == {}
    assert files(tmp_path) == {"half.txt": "text", "whole.txt": "whole"}
    assert (tmp_path / "whole.txt").stat().st_mtime_ns == whole


@pytest.mark.medium
def test_jobs_that_share_cores_run_at_the_same_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfloom.base.device.num_cores", lambda: 4)

    def waits_for(name: str, other: str) -> Job:
        mine, theirs = tmp_path / f"{name}.here", tmp_path / f"{other}.here"
        code = f"{write(mine)}\nwhile not os.path.exists({str(theirs)!r}): time.sleep(0.01)"
        code += f"\nopen({str(tmp_path / name)!r}, 'w').write(os.environ['OMP_NUM_THREADS'])"
        return job(tmp_path, name, code=code, cores=2)

    launcher = Processes(2)
    assert launcher.run([waits_for("a", "b"), waits_for("b", "a")]) == {}
    assert [(tmp_path / name).read_text() for name in "ab"] == ["2", "2"]
    assert launcher.sharing is not None
    assert Processes().sharing is None


@pytest.mark.medium
def test_a_machine_is_not_divided_into_more_than_it_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfloom.base.device.num_cores", lambda: 8)
    some = [job(tmp_path, "two", cores=2), job(tmp_path, "four", cores=4)]
    assert places_for(some, 2) == [{}, {}]
    with pytest.raises(ConfigError, match=r"--jobs 3 with 4 threads each needs 12 CPU cores, .* are 8; .*-threads 2,"):
        places_for(some, 3)
    with pytest.raises(ConfigError, match=r"--jobs 2 with 8 threads each .* --num-threads 4,"):
        places_for([job(tmp_path, "whole", cores=None)], 2)
    assert places_for([job(tmp_path, "whole", cores=None)], 1) == [{}]
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    on_gpu = [Job("gpu", "", (), tmp_path, lambda: False, Resources(None, 1))]
    assert places_for(on_gpu, 2) == [{"CUDA_VISIBLE_DEVICES": "0"}, {"CUDA_VISIBLE_DEVICES": "1"}]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5")
    assert places_for(on_gpu, 2) == [{"CUDA_VISIBLE_DEVICES": "3"}, {"CUDA_VISIBLE_DEVICES": "5"}]
    with pytest.raises(ConfigError, match="--jobs 3 needs as many CUDA devices, and there are 2"):
        places_for(on_gpu, 3)


def test_flags_choose_the_launcher(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert JobFlags().chosen_launcher(tmp_path) == Processes(1)
    assert JobFlags(jobs=3).chosen_launcher(tmp_path) == Processes(3)
    for flags, reason in ((JobFlags(jobs=0), "--jobs is 0"), (JobFlags(ray_address="auto"), "--launcher ray")):
        with pytest.raises(FlagError, match=reason):
            flags.chosen_launcher(tmp_path)
    monkeypatch.setattr("nerfloom.base.extras.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match="--launcher ray needs packages that are not installed: pip install ray"):
        JobFlags(launcher="ray").chosen_launcher(tmp_path).run([])


@pytest.mark.medium
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT], ids=lambda number: number.name)
def test_what_ends_the_launcher_lets_the_job_save_and_the_same_call_goes_on(
    number: signal.Signals, tmp_path: Path
) -> None:
    words, environment = driver(tmp_path, "processes")
    process = subprocess.Popen(words, env=environment, stderr=subprocess.PIPE, text=True)
    until((tmp_path / "second.begun").exists)
    process.send_signal(number)
    said = process.communicate()[1]
    assert ("run the same command to continue" in said) == (number != signal.SIGKILL)
    until((tmp_path / "second.saved").exists)
    assert files(tmp_path) == {"first.txt": "first"}
    kept = (tmp_path / "first.txt").stat().st_mtime_ns
    assert Processes().run([job(tmp_path, "first"), long_job(tmp_path, "second")]) == {}
    assert files(tmp_path) == {"first.txt": "first", "second.txt": "second"}
    assert (tmp_path / "first.txt").stat().st_mtime_ns == kept


def test_a_process_that_ends_before_it_knows_its_job_fails_that_job_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gone = tmp_path / "gone"
    ends = ["sh", "-c", f"exec <&-; : > {shlex.quote(str(gone))}; exit 3"]
    monkeypatch.setattr("nerfloom.jobs.execution.python_command", lambda *_: ends)
    late = SimpleNamespace(dumps=lambda job: json.dumps(job) if until(gone.exists) else "")
    monkeypatch.setattr("nerfloom.jobs.execution.json", late)
    failures = Processes().run([job(tmp_path, "first"), job(tmp_path, "second")])
    assert [failure.reason for failure in failures.values()] == ["exit status 3", "exit status 3"]


def test_a_step_has_its_commands(tmp_path: Path) -> None:
    for step in ({"command": ()}, {"command": ("a",), "started": tmp_path}, {"command": ("a",), "resume": ("b",)}):
        with pytest.raises(ValueError, match="command"):
            Step(**step)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full")
def test_a_full_disk_fails_the_jobs_that_need_it_alone(tmp_path: Path) -> None:
    result = tmp_path / "full.txt"
    full = Job("full", "", (Step(program(write(result))),), Path("/dev/full"), result.exists, Resources(1))
    failures = Processes().run([job(tmp_path, "before"), full, job(tmp_path, "after")])
    assert {failed.title: failure.reason for failed, failure in failures.items()} == {
        "full": f"/dev/full: {os.strerror(errno.ENOSPC)}"
    }
    assert files(tmp_path) == {"after.txt": "after", "before.txt": "before"}


def test_an_error_of_what_keeps_the_results_ends_the_rest(tmp_path: Path) -> None:
    def full(_: Job) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    jobs = [job(tmp_path, "first"), long_job(tmp_path, "second"), job(tmp_path, "third")]
    with pytest.raises(OSError, match="No space left"):
        Processes().run(jobs, full)
    assert files(tmp_path) == {"first.txt": "first"}
