"""What this machine can do at all: the ceilings that kernels are held against."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch


def ceilings() -> dict[str, float]:
    """What this machine can do at all, measured now with torch, on all threads."""

    def best(run: Callable[[], object]) -> float:
        spent = []
        for _ in range(8):
            start = time.perf_counter()
            run()
            spent.append(time.perf_counter() - start)
        return min(spent)

    source = torch.rand(2**25)
    target = torch.empty_like(source)
    a, b = torch.rand(1024, 1024), torch.rand(1024, 1024)
    out = {
        "copy, GB/s": 2 * source.numel() * 4 / best(lambda: target.copy_(source)) / 1e9,
        "float32 matrix product, GFLOP/s": 2 * 1024**3 / best(lambda: a @ b) / 1e9,
    }
    half_a, half_b = a.bfloat16(), b.bfloat16()
    out["bfloat16 matrix product, GFLOP/s"] = 2 * 1024**3 / best(lambda: half_a @ half_b) / 1e9
    for megabytes in (1, 8, 64):
        table = torch.rand(megabytes * 2**17, 2)
        index = torch.randint(len(table), (2**20,))
        seconds = best(lambda table=table, index=index: table.index_select(0, index))  # type: ignore[misc]
        out[f"gather of 8 bytes from {megabytes} MB, G/s"] = 2**20 / seconds / 1e9
    return {name: round(value, 3) for name, value in out.items()}
