"""Several processes that train one run: as one would with their batches together, and alike in every bit."""

import dataclasses
import os
import signal
import socket
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from nerfloom.base import device, processes
from nerfloom.base.device import choose_device, seed_step, shared_stream, stream_seed
from nerfloom.base.machine_config import MachineConfig
from nerfloom.base.processes import Processes, gathered
from nerfloom.cli.session import resume
from nerfloom.data.dataset import Dataset, load_dataset
from nerfloom.data.pixels.batch import draw_batch
from nerfloom.data.pixels.cache import PixelMemory
from nerfloom.data.pixels.stream import PixelStream
from nerfloom.data.sources import Request, ViewSource
from nerfloom.training import mean_gradients as averaging
from nerfloom.training.checkpoint import FOLDER, load_newest
from nerfloom.training.optim import Adam
from nerfloom.training.run import read_run
from tests.cli.helpers import command
from tests.faults import runs
from tests.forked import Forks
from tests.images import write_noise
from tests.patience import PATIENCE
from tests.training import several
from tests.training.helpers import TINY, assert_same_bits, tensors, tiny_trainer

COUNT = 2
STATISTICS = "model.strategy.gradients.sums"
"""Statistics of each process over its own images, until Gaussians are added the next time."""


def free_port() -> int:
    with socket.socket() as connection:
        connection.bind(("127.0.0.1", 0))
        return connection.getsockname()[1]


def numbered() -> list[dict[str, str]]:
    """Variables of two processes, as torchrun numbers them, which itself takes seconds to begin.

    They have no GPU: there may be only one, and its runs do not have the same bits twice.
    """
    port = free_port()
    return [
        {
            "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port),
            "CUDA_VISIBLE_DEVICES": "",
            "WORLD_SIZE": str(COUNT), "LOCAL_WORLD_SIZE": str(COUNT), "RANK": str(rank), "LOCAL_RANK": str(rank),
        }
        for rank in range(COUNT)
    ]  # fmt: skip


def started(*words: object) -> list[subprocess.Popen[str]]:
    """Two processes of a Python command."""
    return [
        subprocess.Popen(
            [sys.executable, "-m", *map(str, words)],
            env={**os.environ, **variables},
            cwd=runs.ROOT,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        for variables in numbered()
    ]


@dataclasses.dataclass
class Two:
    """The files of two processes."""

    folder: Path
    found: list[dict[str, Any]]
    said: list[str]


@pytest.fixture(scope="module")
def two(shared_tiny: Path, tmp_path_factory: pytest.TempPathFactory, forks: Forks) -> Two:
    folder = tmp_path_factory.mktemp("two")
    tiny_trainer("instant-ngp", shared_tiny, folder / "alone", max_num_iterations=several.SHORT).train()
    words, code = (shared_tiny, folder, free_port()), "from tests.training.several import main; main()"
    both = forks.together(*((code, words, variables) for variables in numbered()))
    said = [process.stderr for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    return Two(folder, [torch.load(folder / f"{rank}.pt", weights_only=True) for rank in range(COUNT)], said)


def test_large_gradients_are_averaged_as_small_ones_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Adam takes no notice of a factor, so that no run would tell; the other process has three times our gradients."""
    torch.manual_seed(0)
    small, large = (torch.nn.Parameter(torch.zeros(shape)) for shape in ((3,), (8, 2)))
    optimizer = Adam([{"params": [small, large]}], {}, 1e-2, (0.9, 0.99), 1e-8)
    own = [torch.randn_like(parameter) for parameter in (small, large)]
    small.grad, large.grad = (gradient.clone() for gradient in own)
    monkeypatch.setattr(averaging, "MIN_SEPARATE_SIZE", 16)
    monkeypatch.setattr(averaging, "processes", lambda: Processes(0, COUNT))
    monkeypatch.setattr(averaging, "gathered", lambda ours: [ours] * COUNT)
    monkeypatch.setattr(averaging, "add_up", lambda ours: ours.mul_(4))
    assert averaging.mean_gradients(optimizer, True)
    for parameter, gradient in zip((small, large), own, strict=True):
        torch.testing.assert_close(parameter.grad, 2 * gradient)


@pytest.fixture(scope="module")
def whole(shared_tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """This process's results on the whole batches."""
    return several.parts(shared_tiny, tmp_path_factory.mktemp("whole"))


@pytest.mark.medium
def test_the_mean_gradient_is_that_of_the_whole_batch(two: Two, whole: dict[str, Any]) -> None:
    for found in two.found:
        assert found["parts"]["gradients"].keys() == whole["gradients"].keys()
        for name, gradient in whole["gradients"].items():
            error = (found["parts"]["gradients"][name] - gradient).abs().max() / gradient.abs().max()
            print(f"{name}: {float(error):.1e} of the largest gradient")
            assert float(error) < 1e-5


def test_two_processes_learn_as_one_with_both_batches(two: Two, whole: dict[str, Any]) -> None:
    halves = [found["parts"] for found in two.found]
    means = [sum(losses) / COUNT for losses in zip(*(half["losses"] for half in halves), strict=True)]
    print("losses of one and of two:", [(f"{a:.6f}", f"{b:.6f}") for a, b in zip(whole["losses"], means, strict=True)])
    assert means == pytest.approx(whole["losses"], rel=1e-3)
    assert means[-1] < means[0]
    for name, values in whole["tensors"].items():
        if name.startswith("model.") and values.is_floating_point() and "grid" not in name:
            scale = values.abs().max()
            error = (halves[0]["tensors"][name] - values).abs().max() / scale
            print(f"{name}: {float(error):.1e} of the largest value")
            assert float(error) < 1e-2
    assert_same_bits(halves[0]["tensors"], halves[1]["tensors"])


@pytest.mark.parametrize("method", several.METHODS)
def test_every_process_has_the_same_bits(method: str, two: Two) -> None:
    """After steps with batches of its own."""
    mine, other = (found[method] for found in two.found)
    assert all(one != another for one, another in zip(mine["losses"], other["losses"], strict=True))
    learnt = [dict(found["tensors"]) for found in (mine, other)]
    if method == "gaussian-splatting":
        assert len(learnt[0]["model.means.values"]) != TINY[method]["start_gaussians"]
        assert learnt[0].pop(STATISTICS).shape == learnt[1].pop(STATISTICS).shape
    assert_same_bits(*learnt)


def test_one_process_continues_what_two_have_begun(two: Two, shared_tiny: Path, tmp_path: Path) -> None:
    for method, steps in several.METHODS.items():
        content = load_newest(two.folder / "0" / method / FOLDER)
        assert content is not None
        trainer = tiny_trainer(method, shared_tiny, tmp_path / method, max_num_iterations=steps + 2)
        trainer.restore(content)
        assert_same_bits(two.found[0][method]["tensors"], tensors(trainer))
        trainer.train()
        assert trainer.state.step == steps + 2
        assert trainer.state.skipped == 0


def test_two_processes_continue_what_one_has_begun(two: Two) -> None:
    content = load_newest(two.folder / "alone" / FOLDER)
    assert content is not None
    for found in two.found:
        saved = {f"model.{name}": value for name, value in content["model"].items()}
        assert_same_bits(saved, {name: found["resumed"]["before"][name] for name in saved})
        assert found["resumed"]["step"] == 2 * several.SHORT
    assert_same_bits(*(found["resumed"]["tensors"] for found in two.found))


def test_what_one_process_meets_concerns_all(two: Two) -> None:
    """A step that is not finite in one is dropped by all; without a gradient in one; a signal to one stops all."""
    for found in two.found:
        assert found["disturbed"]["skipped"] == 1
        assert found["disturbed"]["step"] == several.SHORT
        assert found["disturbed"]["stopped_by"] == signal.SIGTERM
    assert_same_bits(*(found["disturbed"]["tensors"] for found in two.found))


def test_the_first_process_has_the_clock(two: Two) -> None:
    mine, other = (found["timed"] for found in two.found)
    assert mine["reason"] == other["reason"] == "0.2 s of training spent"
    assert (mine["step"], mine["seconds"]) == (other["step"], other["seconds"])
    assert_same_bits(mine["tensors"], other["tensors"])


def test_the_first_process_alone_prints_and_writes(two: Two) -> None:
    assert two.said[1] == ""
    assert "2 processes " in two.said[0]
    assert "12 steps done: step 12, " in two.said[0]
    assert "test: " in two.said[0]
    names = {Path(file).name for file in two.found[0]["files"]}
    assert any("config.yml" in name for name in names)
    assert two.found[1]["files"] == []
    assert len(list((two.folder / "outputs").glob("*/*/*/config.yml"))) == 1
    assert not (two.folder / "1" / "instant-ngp" / FOLDER).exists()


@pytest.mark.slow
@pytest.mark.parametrize("killed", [0, 1])
def test_if_one_process_is_killed_the_other_ends_and_says_how_to_continue(
    killed: int, shared_tiny: Path, tmp_path: Path
) -> None:
    flags, folder = runs.new_run(shared_tiny, tmp_path, 100_000)
    both = started("nerfloom.cli.train", *flags)
    runs.wait_for_checkpoint(both[0], folder)
    both[killed].kill()
    said = [runs.ended(process) for process in both]
    assert both[1 - killed].returncode == 1
    errors = [line for line in said[1 - killed].splitlines() if "error" in line]
    assert len(errors) == 1
    assert errors[0].startswith("error: step ")
    assert errors[0].endswith(f": another process of this run has ended; continue with: ns-train --resume {folder}")
    if killed == 0:
        assert said[1].splitlines() == errors
        return
    step = int(errors[0].removeprefix("error: step ").split(":")[0].replace(",", ""))
    assert said[1] == ""
    assert runs.readable_steps(folder)[-1] == step
    run = read_run(folder / "config.yml")
    resume(dataclasses.replace(run, config=dataclasses.replace(run.config, max_num_iterations=step + 5)))
    assert runs.readable_steps(folder)[-1] == step + 5


@pytest.mark.slow
def test_torchrun(shared_tiny: Path, tmp_path: Path) -> None:
    flags, folder = runs.new_run(shared_tiny, tmp_path, 30, evaluated=15)
    launch = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", "--master-port", free_port()]
    environment = {**os.environ, "OMP_WAIT_POLICY": "PASSIVE", "PYTHONPATH": str(runs.ROOT)}
    done = subprocess.run(
        [*map(str, launch), command("ns-train"), *map(str, flags)],
        env=environment, capture_output=True, text=True, timeout=PATIENCE, cwd=runs.ROOT,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("30 steps done: step 30, ") == 1
    assert runs.readable_steps(folder)[-1] == 30
    assert [step for step, _ in runs.curve(folder)] == [15, 30]


# -- what needs no second process ---------------------------------------------------------------------------------


@pytest.fixture
def second_of_two(monkeypatch: pytest.MonkeyPatch) -> None:
    """This process takes itself for the second of two."""
    monkeypatch.setattr(processes, "_joined", Processes(1, 2, 1, 2))


@pytest.fixture(scope="module")
def noise(tmp_path_factory: pytest.TempPathFactory) -> tuple[Dataset, Dataset]:
    """The same images in memory and in a file."""
    folder = tmp_path_factory.mktemp("noise")
    scene = write_noise(folder / "images", [(20, 10), (7, 30), (16, 16)], channels=3, suffix=".png")
    return load_dataset(scene, "train"), load_dataset(scene, "train", PixelMemory(0, folder / "cache"))


def test_streams_of_random_numbers_differ_and_the_first_is_that_of_one_process() -> None:
    assert stream_seed(7, 3, 0) == stream_seed(7, 3)
    seeds = {stream_seed(7, step, stream) for step in range(50) for stream in range(-2, 8)}
    assert len(seeds) == 500


@pytest.mark.usefixtures("second_of_two")
def test_a_shared_stream_is_another_and_leaves_that_of_the_process_as_it_was() -> None:
    def drawn(before: int) -> tuple[float, float]:
        seed_step(7, 3, 1)
        torch.rand(before)
        with shared_stream(7, 3, device.BEFORE_STEP):
            shared = float(torch.rand(()))
        return shared, float(torch.rand(()))

    seed_step(7, 3, 1)
    own = torch.rand(6)
    assert drawn(0)[0] == drawn(5)[0]
    assert (drawn(0)[1], drawn(5)[1]) == (float(own[0]), float(own[5]))


@pytest.mark.usefixtures("second_of_two")
def test_pixels_of_a_second_process_are_read_ahead(noise: tuple[Dataset, Dataset]) -> None:
    here, there = noise
    stream = PixelStream(there, 7)
    for step in (0, 1, 2, 9):
        batches = []
        for data, look_up in ((here, None), (there, partial(stream.look_up, step))):
            seed_step(7, step, 1)
            batches.append(draw_batch(data, 50, "black", look_up=look_up))
        assert torch.equal(batches[0].rgb, batches[1].rgb)


def test_processes_take_turns_in_the_images(noise: tuple[Dataset, Dataset], monkeypatch: pytest.MonkeyPatch) -> None:
    def views(rank: int, count: int, steps: int) -> list[int]:
        monkeypatch.setattr(processes, "_joined", Processes(rank, count))
        source = ViewSource(noise[0], "black", 7)
        return [source.draw(Request(step, 0)).index for step in range(steps)]

    one = views(0, 1, 18)
    assert [sorted(one[first : first + 3]) for first in range(0, 18, 3)] == [[0, 1, 2]] * 6
    assert views(0, 2, 9) == one[::2]
    assert views(1, 2, 9) == one[1::2]


def test_processes_of_a_machine_share_its_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    before = torch.get_num_threads()
    monkeypatch.setattr(device, "num_cores", lambda: 8)
    try:
        for local_count, given, threads in ((2, None, 4), (3, None, 2), (16, None, 1), (2, 3, 3), (1, None, 5)):
            torch.set_num_threads(5)
            monkeypatch.setattr(processes, "_joined", Processes(0, max(local_count, 2), 0, local_count))
            choose_device(MachineConfig(device_type="cpu", num_threads=given))
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)


def test_one_process_is_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """torchrun's variables are set for one process, or only some of them, as other programs set them."""
    for name, value in (("RANK", "0"), ("WORLD_SIZE", "1"), ("MASTER_ADDR", "127.0.0.1")):
        monkeypatch.setenv(name, value)
    with processes.joined_processes() as one:
        assert one == Processes()
        assert gathered([1, 2.5]) == [[1.0, 2.5]]
    monkeypatch.setenv("WORLD_SIZE", "4")
    monkeypatch.delenv("MASTER_ADDR")
    with processes.joined_processes() as one:
        assert one.count == 1
