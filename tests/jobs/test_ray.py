"""Jobs on a real Ray cluster, started on this machine."""

import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

pytest.importorskip("ray", reason="Ray is not installed: pip install ray")

from nerfloom.base.errors import ConfigError
from nerfloom.jobs import ray as ray_launcher
from nerfloom.jobs.job import Job
from nerfloom.jobs.processes import Processes
from nerfloom.jobs.ray import Ray
from tests.jobs.tiny import driver, files, job, long_job, write
from tests.patience import until

pytestmark = pytest.mark.slow  # a cluster starts within seconds


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two workers, wherever the tests run."""
    monkeypatch.setattr("nerfloom.base.device.num_cores", lambda: 2)


def that_kills_its_worker(folder: Path, name: str, times: int) -> Job:
    """A job that kills the process of the Ray worker that runs it; the parent of its parent."""
    deaths = folder / f"{name}.deaths"
    code = f"""
deaths = pathlib.Path({str(deaths)!r})
before = deaths.stat().st_size if deaths.exists() else 0
if before < {times}:
    worker = int(pathlib.Path(f"/proc/{{os.getppid()}}/stat").read_text().rsplit(")", 1)[1].split()[1])
    deaths.write_text("x" * (before + 1))
    os.kill(worker, signal.SIGKILL)
    while True: time.sleep(0.01)"""
    return job(folder, name, code=code)


def waits_for(folder: Path, name: str, other: str) -> Job:
    """A job that ends only beside another one."""
    here, there = folder / f"{name}.here", folder / f"{other}.here"
    return job(folder, name, code=f"{write(here)}\nwhile not os.path.exists({str(there)!r}): time.sleep(0.01)")


def test_two_workers_of_which_one_is_killed_three_times(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one, other = tmp_path / "processes", tmp_path / "ray"
    for folder in (one, other):
        folder.mkdir()
    bad = "sys.exit('error: its disk is on fire')"
    jobs = [waits_for(other, "a", "b"), waits_for(other, "b", "a"), that_kills_its_worker(other, "unlucky", 3)]
    jobs += [job(other, "bad", code=bad), job(other, "last")]
    seen: list[str] = []
    failures = Ray().run(jobs, lambda done: seen.append(done.title))
    assert {failed.title: failure.reason for failed, failure in failures.items()} == {"bad": "its disk is on fire"}
    assert sorted(seen) == ["a", "b", "last", "unlucky"]
    lost = [line for line in capsys.readouterr().err.splitlines() if "worker lost" in line]
    print("\n".join(lost))
    assert len(lost) == 3
    died = "worker lost (WorkerCrashedError: The worker died unexpectedly while executing this task)"
    assert [line.strip() for line in lost] == [
        f"unlucky: {died}; the job continues on another, {number} of 5" for number in (1, 2, 3)
    ]
    Processes().run([job(one, name) for name in ("a", "b", "unlucky")] + [job(one, "bad", code=bad), job(one, "last")])
    assert files(other) == files(one)
    assert (other / "logs" / "last.log").read_text().endswith("last\n")
    assert (other / "logs" / "unlucky.log").read_text().splitlines().count("unlucky") == 4  # of every start


def test_a_job_that_loses_every_worker_fails_alone(tmp_path: Path) -> None:
    failures = Ray().run([that_kills_its_worker(tmp_path, "cursed", 100), job(tmp_path, "good")])
    assert [failed.title for failed in failures] == ["cursed"]
    assert files(tmp_path) == {"good.txt": "good"}


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM], ids=lambda number: number.name)
def test_what_ends_the_head_lets_the_job_save_and_the_same_call_goes_on(number: signal.Signals, tmp_path: Path) -> None:
    words, environment = driver(tmp_path, "ray")
    process = subprocess.Popen(words, env=environment, stderr=subprocess.DEVNULL)
    until(lambda: (tmp_path / "second.begun").exists() and (tmp_path / "first.txt").exists())
    process.send_signal(number)
    process.wait()
    until((tmp_path / "second.saved").exists)
    assert files(tmp_path) == {"first.txt": "first"}
    kept = (tmp_path / "first.txt").stat().st_mtime_ns
    assert Ray().run([job(tmp_path, "first"), long_job(tmp_path, "second")]) == {}
    assert files(tmp_path) == {"first.txt": "first", "second.txt": "second"}
    assert (tmp_path / "first.txt").stat().st_mtime_ns == kept


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[str, Callable[[], None]]]:
    """The address of a running cluster, and a function that kills its head: Ray's gcs_server and raylet."""
    # Otherwise Ray asks for a token only where an earlier cluster has left one in ~/.ray.
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN", secrets.token_hex(32))
    folder = tempfile.mkdtemp(prefix="ray")  # paths of Ray's sockets must be short
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]

    def kill_head() -> None:
        for words in Path("/proc").glob("[0-9]*/cmdline"):
            with suppress(OSError):  # it has ended
                said = words.read_bytes()
                if folder.encode() in said and Path(said.split(b"\0")[0].decode()).name in ("gcs_server", "raylet"):
                    os.kill(int(words.parent.name), signal.SIGKILL)

    program = Path(sys.executable).with_name("ray")
    start = ("start", "--head", "--port", str(port), "--num-cpus", "2", "--include-dashboard", "false")
    process = subprocess.Popen([program, *start, "--temp-dir", folder], start_new_session=True)
    try:
        assert process.wait() == 0
        yield f"127.0.0.1:{port}", kill_head
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        shutil.rmtree(folder, ignore_errors=True)


@pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="looks for processes in /proc")
def test_a_killed_head_of_a_running_cluster_loses_nothing(
    cluster: tuple[str, Callable[[], None]], tmp_path: Path
) -> None:
    address, kill = cluster
    words, environment = driver(tmp_path, "ray", address)
    words[2] = f"from nerfloom.jobs import head\nhead.AWAY = 2.0\n{words[2]}"  # instead of half a minute
    process = subprocess.Popen(words, env=environment, stderr=subprocess.PIPE, text=True)

    def begun() -> bool:
        assert process.poll() is None, process.communicate()
        return (tmp_path / "second.begun").exists() and (tmp_path / "first.txt").exists()

    until(begun)
    kept = (tmp_path / "first.txt").stat().st_mtime_ns
    kill()
    said = " ".join(process.communicate()[1].split())
    assert process.returncode == 1
    port = address.partition(":")[2]
    assert "error: the head of the Ray cluster, " in said
    assert said.endswith(
        f":{port}, is lost: no connection for 2 s. Finished jobs are kept, and running ones save; run the same command "
        "again on a running cluster, or without --ray-address"
    )
    until((tmp_path / "second.saved").exists)
    assert files(tmp_path) == {"first.txt": "first"}
    assert Processes().run([job(tmp_path, "first"), long_job(tmp_path, "second")]) == {}
    assert files(tmp_path) == {"first.txt": "first", "second.txt": "second"}
    assert (tmp_path / "first.txt").stat().st_mtime_ns == kept


def test_a_cluster_that_does_not_start_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ray raises a plain Exception where its processes do not start in time, as on a busy machine."""

    def late(*_: object, **__: object) -> None:
        raise Exception("The current node timed out during startup. This could happen because\nof much")

    monkeypatch.setattr("ray.init", late)
    with pytest.raises(ConfigError, match=r"^cannot start Ray here: The current node timed out during startup\."):
        Ray().run([job(tmp_path, "a")])


def test_machines_that_see_other_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_launcher, "_sees", lambda path: ("mars", False))
    with pytest.raises(ConfigError, match=rf"the machine mars of the cluster does not see {tmp_path / 'logs'}; "):
        Ray().run([job(tmp_path, "a")])
    assert [path.name for path in tmp_path.rglob("*")] == ["logs"]


def test_an_address_where_no_cluster_is(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--ray-address auto: cannot connect"):
        Ray(address="auto").run([job(tmp_path, "a")])
