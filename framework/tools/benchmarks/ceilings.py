"""What this machine can do at all: the ceilings that kernels are held against."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import torch

TABLES = (1, 8, 64)
"""MB of the tables that are gathered from."""


@dataclass(frozen=True)
class Work:
    """What a kernel has to do for each sample, ray, entry or pixel, whatever else it does."""

    bytes: float = 0.0
    """Read or written in order."""
    gathers: float = 0.0
    """Of 8 bytes at places that nobody knows beforehand."""
    table_bytes: float = 0.0
    """Of what is gathered from."""
    flops: float = 0.0
    """Of matrix products; a multiplication and an addition are two."""
    bfloat16: bool = False
    """Whether the products are of bfloat16."""


@dataclass(frozen=True)
class Ceilings:
    """Measured with torch, on all threads."""

    copy: float
    """Bytes read and written, 1/s."""
    float32: float
    """Of a product of matrices of 1024 x 1024, FLOP/s."""
    bfloat16: float
    """The same in bfloat16."""
    gathers: dict[int, float] = field(default_factory=dict)
    """Of 8 bytes, 1/s, by the table's MB."""

    @classmethod
    def measured(cls) -> Ceilings:
        """The best of eight runs each, now."""
        source = torch.rand(2**25)
        target = torch.empty_like(source)
        a, b = torch.rand(1024, 1024), torch.rand(1024, 1024)
        half_a, half_b = a.bfloat16(), b.bfloat16()
        gathers = {}
        for megabytes in TABLES:
            table = torch.rand(megabytes * 2**17, 2)
            index = torch.randint(len(table), (2**20,))
            gathers[megabytes] = len(index) / _best(lambda t=table, i=index: t.index_select(0, i))  # type: ignore[misc]
        return cls(
            copy=2 * source.nbytes / _best(lambda: target.copy_(source)),
            float32=2 * 1024**3 / _best(lambda: a @ b),
            bfloat16=2 * 1024**3 / _best(lambda: half_a @ half_b),
            gathers=gathers,
        )

    def seconds(self, work: Work) -> float:
        """What the slowest part of some work takes at its ceiling's rate, the others being free.

        Gathers are held against those at random from the smallest table measured that is no smaller. Neighbours in
        space share much of what they gather, so a kernel may well be faster than that.
        """
        size = next((size for size in TABLES if size * 2**20 >= work.table_bytes), TABLES[-1])
        products = self.bfloat16 if work.bfloat16 else self.float32
        return max(work.bytes / self.copy, work.gathers / self.gathers[size], work.flops / products)

    def lines(self) -> list[str]:
        """For people."""
        gathers = ", ".join(f"{rate / 1e9:.2f} from {size} MB" for size, rate in self.gathers.items())
        return [
            f"copy {self.copy / 1e9:.1f} GB/s",
            f"matrix product {self.float32 / 1e9:.0f} GFLOP/s, in bfloat16 {self.bfloat16 / 1e9:.0f}",
            f"random gathers of 8 bytes, G/s: {gathers}",
        ]


def _best(run: Callable[[], object]) -> float:
    spent = []
    for _ in range(8):
        start = time.perf_counter()
        run()
        spent.append(time.perf_counter() - start)
    return min(spent)
