"""The benchmark of kernels: its comparisons, and that it measures every kernel."""

from pathlib import Path

import pytest
import torch

from nerfloom.benchmarks import bars
from nerfloom.benchmarks.ceilings import Ceilings, Work
from nerfloom.benchmarks.kernels import kernels, measured
from nerfloom.benchmarks.timing import alternating
from nerfloom.kernels import native

CEILINGS = Ceilings(copy=40e9, float32=200e9, bfloat16=800e9, gathers={1: 1e9, 8: 0.5e9, 64: 0.1e9})
needs_kernels = pytest.mark.skipif(not native.available(), reason="no compiled kernels")


@pytest.mark.parametrize(
    ("work", "nanoseconds"),
    [
        (Work(bytes=80), 2),
        (Work(flops=4000), 20),
        (Work(flops=4000, bfloat16=True), 5),
        (Work(gathers=2, table_bytes=2**20), 2),
        (Work(gathers=2, table_bytes=2**20 + 1), 4),
        (Work(gathers=2, table_bytes=2**40), 20),
        (Work(bytes=80, gathers=2, table_bytes=1, flops=4000), 20),
    ],
)
def test_the_slowest_part_of_work_is_what_it_takes(work: Work, nanoseconds: float) -> None:
    assert CEILINGS.seconds(work) == pytest.approx(nanoseconds * 1e-9)


def test_medians_of_stages_and_of_neighbours_ratios() -> None:
    """The first run of each is a warm-up; a run on a machine that was ten times slower for a moment changes nothing."""
    ours = iter([[99, 99], [1, 2], [10, 20], [1, 3]])
    theirs = iter([[99, 99], [2, 4], [20, 40], [4, 4]])
    times = alternating(lambda: next(ours), lambda: next(theirs), repeats=3)
    assert (times.compiled, times.reference, times.speed_up) == ([1, 3], [4, 4], 2)


@needs_kernels
def test_a_kernel_is_measured_on_one_thread_and_on_all() -> None:
    rows = measured(next(kernels(256)), CEILINGS, 1, torch.get_num_threads())
    assert [row.threads for row in rows] == sorted({1, torch.get_num_threads()})
    for row in rows:
        assert row.forward > 0
        assert row.errors is not None
        assert row.errors.value < 1e-3


@needs_kernels
@pytest.mark.slow  # tables of 512^2 vertices in float64
def test_every_kernel_is_measured_and_right(tmp_path: Path) -> None:
    threads = torch.get_num_threads()
    rows = [row for kernel in kernels(256) for row in measured(kernel, CEILINGS, 1, threads)]
    assert torch.get_num_threads() == threads
    names = {row.kernel for row in rows}
    assert len(rows) == len(names) * len({1, threads})
    for start in ("hash grid", "network", "compositing", "frequency", "spherical", "K-Planes", "TensoRF", "marching",
                  "sparse Adam", "multisampled grid", "loss of proposals", "loss with SSIM", "projection of Gaussians",
                  "sorting Gaussians", "blending of Gaussians",
                  "rays of opencv"):  # fmt: skip
        assert any(name.startswith(start) for name in names), start
    for row in rows:
        assert row.forward > 0
        assert row.speed_up > 0
        assert (row.backward is None) == (row.reference_backward is None)
        assert row.at_ceiling is None or row.at_ceiling > 0
        if row.errors is not None and row.reference_errors is not None:
            allowed = 0.1 if "bfloat16" in row.kernel else 1e-3
            assert row.errors.value < allowed
            assert row.reference_errors.value < 1e-3
            assert (row.errors.gradient is None) == (row.backward is None)
    pytest.importorskip("matplotlib")
    bars.draw(rows[:4], tmp_path / "pictures" / "kernels.png")
    assert (tmp_path / "pictures" / "kernels.png").read_bytes().startswith(b"\x89PNG")
