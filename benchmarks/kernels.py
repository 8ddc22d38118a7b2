"""Time per sample and error of each fast path against its torch reference, in one process, in alternating runs.

    python benchmarks/kernels.py [--samples N] [--repeats K]

writes benchmarks/results/kernels.json with the machine and versions. Times are medians; the ratio is the median of
the ratios of neighbouring runs, which a machine whose speed drifts disturbs least.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import torch
from torch import Tensor

from framework.kernels.hash_grid import HashGridLayout, hash_grid, hash_grid_reference

RESULTS = Path(__file__).parent / "results" / "kernels.json"


def seconds(function: Callable[[], object]) -> float:
    """Wall time of one call."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def forward_backward(encode: Callable[..., Tensor], positions: Tensor, table: Tensor, layout: HashGridLayout) -> None:
    """One training step's worth of encoding."""
    table.grad = None
    encode(positions, table, layout).sum().backward()


def hash_grid_row(samples: int, repeats: int, log2_table_size: int) -> dict[str, object]:
    """The hash grid with 16 levels of 2 features, finest 1024."""
    torch.manual_seed(0)
    layout = HashGridLayout.build(16, 16, 1024, log2_table_size)
    positions = torch.rand(samples, 3)
    table = torch.randn(layout.num_entries, 2, requires_grad=True)
    times: dict[str, list[float]] = {"fast": [], "reference": []}
    for repeat in range(repeats + 1):
        for name, encode in (("fast", hash_grid), ("reference", hash_grid_reference)):
            spent = seconds(lambda encode=encode: forward_backward(encode, positions, table, layout))  # type: ignore[misc]
            if repeat:  # the first is a warm-up
                times[name].append(spent)
    ratios = [slow / fast for fast, slow in zip(times["fast"], times["reference"], strict=True)]
    truth = hash_grid_reference(positions[:4096].double(), table.detach().double(), layout)
    error = (hash_grid(positions[:4096], table.detach(), layout).double() - truth).abs().max() / truth.abs().max()
    return {
        "kernel": f"hash grid, 16 levels x 2, tables of 2^{log2_table_size}",
        "samples": samples,
        "fast_ns_per_sample": round(median(times["fast"]) / samples * 1e9, 1),
        "reference_ns_per_sample": round(median(times["reference"]) / samples * 1e9, 1),
        "speed_up": round(median(ratios), 2),
        "speed_up_range": [round(min(ratios), 2), round(max(ratios), 2)],
        "largest_error_relative_to_largest_value": float(error),
    }


def main() -> None:
    """Run every row, print it and write them all."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--samples", type=int, default=2**15)
    parser.add_argument("--repeats", type=int, default=9)
    flags = parser.parse_args()
    rows = [hash_grid_row(flags.samples, flags.repeats, size) for size in (15, 17, 19)]
    for row in rows:
        print(row)
    machine = {
        "processor": platform.processor() or platform.machine(),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "python": platform.python_version(),
    }
    RESULTS.write_text(json.dumps({"machine": machine, "rows": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()
