"""Limits of a device for comparison with kernel times: copying, matrix products and gathers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import torch

from nerfloom.benchmarks.timing import now

TABLES = (1, 8, 64)
"""Sizes of the tables for gathers, MiB."""


@dataclass(frozen=True)
class Work:
    """Minimum work of a kernel per unit: sample, ray, entry, pixel or Gaussian."""

    bytes: float = 0.0
    """Bytes read or written in order."""
    gathers: float = 0.0
    """Number of reads of 8 bytes at random places."""
    table_bytes: float = 0.0
    """Size of the table for gathers, bytes."""
    flops: float = 0.0
    """Floating-point operations of matrix products; a multiplication and an addition count as two."""
    bfloat16: bool = False
    """Whether the products are in bfloat16."""


@dataclass(frozen=True)
class Ceilings:
    """Maximum rates of the machine, measured with torch on all threads."""

    copy: float
    """Bytes read and written, 1/s."""
    float32: float
    """Product of matrices, FLOP/s."""
    bfloat16: float
    """Product of such matrices in bfloat16, FLOP/s."""
    gathers: dict[int, float] = field(default_factory=dict)
    """Random reads of 8 bytes, 1/s, by the size of the table, MiB."""

    @classmethod
    def measured(cls, copied: int = 2**25, edge: int = 1024) -> Ceilings:
        """Measure the limits on torch's default device by `copied` values and `edge` rows, best of eight runs."""
        source = torch.rand(copied)
        target = torch.empty_like(source)
        a, b = torch.rand(edge, edge), torch.rand(edge, edge)
        half_a, half_b = a.bfloat16(), b.bfloat16()
        gathers = {}
        for megabytes in TABLES:
            table = torch.rand(megabytes * 2**17, 2)
            index = torch.randint(len(table), (2**20,))
            gathers[megabytes] = len(index) / _best(lambda t=table, i=index: t.index_select(0, i))  # type: ignore[misc]
        return cls(
            copy=2 * source.nbytes / _best(lambda: target.copy_(source)),
            float32=2 * edge**3 / _best(lambda: a @ b),
            bfloat16=2 * edge**3 / _best(lambda: half_a @ half_b),
            gathers=gathers,
        )

    def seconds(self, work: Work) -> float:
        """Return the seconds of the slowest part of `work` at its maximum rate.

        For gathers, the rate is measured by random reads from the smallest measured table that is large enough.
        Neighbours in space share many entries, so a kernel can be faster.
        """
        size = next((size for size in TABLES if size * 2**20 >= work.table_bytes), TABLES[-1])
        products = self.bfloat16 if work.bfloat16 else self.float32
        return max(work.bytes / self.copy, work.gathers / self.gathers[size], work.flops / products)

    def lines(self) -> list[str]:
        """Return the limits as lines of text."""
        gathers = ", ".join(f"{rate / 1e9:.2f} from {size} MB" for size, rate in self.gathers.items())
        return [
            f"copy {self.copy / 1e9:.1f} GB/s",
            f"matrix product {self.float32 / 1e9:.0f} GFLOP/s, in bfloat16 {self.bfloat16 / 1e9:.0f}",
            f"random gathers of 8 bytes, G/s: {gathers}",
        ]


def _best(run: Callable[[], object]) -> float:
    times = []
    for _ in range(8):
        start = now()
        run()
        times.append(now() - start)
    return min(times)
