"""Results do not depend on threads: on their wanted and real number, and on their shares of the work."""

import json
import os
import subprocess
import sys
import threading

import pytest
import torch
from torch import Tensor

from nerfloom.kernels import native
from nerfloom.kernels.networks.mlp import mlp
from tests.forked import Forks
from tests.kernels.compiled import needs_kernels
from tests.kernels.large import bits, measured
from tests.patience import PATIENCE

pytestmark = needs_kernels
ENVIRONMENTS = {
    "a limit of one thread": {"OMP_THREAD_LIMIT": "1", "OMP_NUM_THREADS": "2"},
    "fewer threads as the system likes": {"OMP_DYNAMIC": "true"},
    "one thread": {"OMP_NUM_THREADS": "1"},
    "two threads": {"OMP_NUM_THREADS": "2"},
    "three threads": {"OMP_NUM_THREADS": "3"},
    "eight threads": {"OMP_NUM_THREADS": "8"},
    "threads that sleep": {"OMP_WAIT_POLICY": "PASSIVE", "OMP_NUM_THREADS": "2"},
}
QUICK = "a limit of one thread"
"""Beside it, any number of threads is asked for in this process."""
TOLERANCE = 2e-5
Measured = dict[str, tuple[float, list[Tensor]]]


@pytest.fixture(scope="module")
def here() -> Measured:
    """Measurements of this process on one thread."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    found = measured()
    torch.set_num_threads(before)
    return found


def in_a_process(**environment: str) -> dict[str, object]:
    kept = {name: value for name, value in os.environ.items() if not name.startswith("OMP_")}
    # Asked for by name too, for torch takes no more than there are cores from its environment.
    threads = environment.get("OMP_NUM_THREADS", "2")
    run = [sys.executable, "-m", "tests.kernels.large", threads]
    done = subprocess.run(run, env=kept | environment, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.medium
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == QUICK else pytest.mark.slow) for name in ENVIRONMENTS]
)
def test_values_and_gradients_are_the_references_in_every_environment(name: str, here: Measured) -> None:
    """Here they are near the references, and there they have the same bits."""
    errors = {operation: error for operation, (error, _) in here.items()}
    found = in_a_process(**ENVIRONMENTS[name])
    print(name, found["threads"], "threads; largest error", max(errors.values()))
    assert [operation for operation, error in errors.items() if not error < TOLERANCE] == []
    assert found["bits"] == bits(here)


@pytest.mark.medium
def test_eight_threads_compute_the_bits_of_one(here: Measured) -> None:
    """More than most machines have cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(8)
    try:
        found = measured(judged=False)
    finally:
        torch.set_num_threads(before)
    assert bits(found) == bits(here)


def test_several_callers_at_once_get_what_one_gets() -> None:
    """One of them has the threads, the others work alone meanwhile."""
    torch.manual_seed(0)
    inputs, weights = [torch.randn(20_000, 32)], [torch.randn(64, 32), torch.randn(16, 64)]
    expected, found = mlp(inputs, weights), []
    callers = [threading.Thread(target=lambda: found.extend(mlp(inputs, weights) for _ in range(10))) for _ in range(4)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert len(found) == 40
    assert all(torch.equal(value, expected) for value in found)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system has no fork")
def test_a_forked_process_has_threads_of_its_own(forks: Forks) -> None:
    """The test runs in a process of its own, because a fork of this one would hold its files."""
    code = (
        "import os, torch\n"
        "from nerfloom.kernels.networks.mlp import mlp\n"
        "torch.manual_seed(0); torch.set_num_threads(2)\n"
        "x, w = [torch.randn(20_000, 32)], [torch.randn(64, 32), torch.randn(16, 64)]\n"
        "expected = mlp(x, w)\n"
        "child = os.fork()\n"
        "if child == 0: os._exit(0 if all(torch.equal(mlp(x, w), expected) for _ in range(20)) else 1)\n"
        "print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), torch.equal(mlp(x, w), expected))"
    )
    done = forks.run(code)
    assert done.stdout.split() == ["0", "True"], done.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="sets the default size of stacks as Linux allows it")
def test_threads_have_a_stack_for_a_chunk_where_the_system_gives_less(forks: Forks) -> None:
    """As on macOS, where a thread has less than the backward pass of a network takes."""
    code = (
        "import ctypes, torch\n"
        "from nerfloom.kernels.networks.mlp import mlp\n"
        "libc, usual = ctypes.CDLL(None), ctypes.create_string_buffer(256)\n"
        "assert libc.pthread_attr_init(usual) == 0\n"
        "assert libc.pthread_attr_setstacksize(usual, ctypes.c_size_t(2**18)) == 0\n"
        "assert libc.pthread_setattr_default_np(usual) == 0\n"
        "torch.manual_seed(0)\n"
        "x, w = [torch.randn(20_000, 32)], [torch.randn(64, 32), torch.randn(16, 64)]\n"
        "def gradients(threads):\n"
        "    torch.set_num_threads(threads)\n"
        "    leaves = [weight.clone().requires_grad_() for weight in w]\n"
        "    return torch.autograd.grad(mlp(x, leaves).square().sum(), leaves)\n"
        "alone = gradients(1)\n"
        "print(all(torch.equal(a, b) for _ in range(20) for a, b in zip(alone, gradients(4))))"
    )
    done = forks.run(code)
    assert (done.returncode, done.stdout.split()) == (0, ["True"]), done.stderr


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_an_error_in_one_chunk_is_raised_and_the_next_call_works(threads: int) -> None:
    from nerfloom.data.pixels.batch import gather_colors

    pixels, behind = torch.randint(256, (100, 4)).to(torch.uint8), torch.rand(50_000, 3)
    good, before = torch.randint(100, (50_000,)), torch.get_num_threads()
    bad = good.clone()
    bad[41_234] = 100
    torch.set_num_threads(threads)
    try:
        expected = gather_colors(pixels, good, behind)[0]
        for _ in range(5):
            with pytest.raises(IndexError, match=r"pixels: index 100 .*100"):
                gather_colors(pixels, bad, behind)
            assert torch.equal(gather_colors(pixels, good, behind)[0], expected)
    finally:
        torch.set_num_threads(before)


def test_memory_that_is_not_there_is_an_error_and_not_the_end_of_the_process() -> None:
    refresh = native.Function("refresh_occupancy", "pqffffpi")
    with pytest.raises(MemoryError, match="refresh_occupancy: there is not enough memory"):
        refresh(None, 2**62, 1.0, 0.1, 0.01, 0.0, None, 2)  # sums of this many cells cannot be addressed


def test_what_no_kernel_can_do_is_refused_by_name() -> None:
    forward = native.Function("hash_grid_forward", "pqpippipi")
    with pytest.raises(ValueError, match=r"hash_grid_forward: .*1, 2, 4 or 8 features"):
        forward(None, 0, None, 3, None, None, 1, None, 1)
    network = native.Function("mlp_forward", "ppiqpippippi")
    with pytest.raises(ValueError, match="a layer has 1 to 384 features"):
        network(None, None, 1, 0, native.integers((385, 4)), 1, None, None, 0, None, None, 1)


def test_results_are_finite(here: Measured) -> None:
    """The hash is of numbers, not of NaN."""
    assert all(bool(t.isfinite().all()) for _, tensors in here.values() for t in tensors)
