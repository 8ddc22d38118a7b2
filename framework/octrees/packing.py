"""Leaves rounded to bytes.

An optical depth tau of a cell's edge is stored as tau / (1 + tau) in equal steps: small depths keep their opacity, and
large ones, which hide everything behind them, lose digits. A coefficient is stored in equal steps between two quantiles
of its harmonic; the few values outside are clipped.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from nerfloom.kernels.octree.packed import CODES, PackedLeaves

MAX_DEPTH = 100.0
"""Maximum stored optical depth of a cell's edge; exp(-100) is 0 in every picture."""
CLIPPED = 2e-4
"""Share of a coefficient's values that is clipped, at each end."""
LOOKED_AT = 2**17
"""Number of leaves for finding quantiles."""


@dataclass(frozen=True)
class Rounding:
    """The errors of leaves that were rounded to bytes."""

    opacity: float
    """Root mean square of the error of a cell's opacity."""
    color: float
    """Root mean square of the error of a coefficient, in the unit of colours: times the first harmonic."""


def packed(depths: Tensor, coefficients: Tensor, bits: int = 8) -> tuple[PackedLeaves, Rounding]:
    """Round leaves to bytes.

    Args:
        depths: (L,) optical depth of a cell's edge.
        coefficients: (L, 3 K) coefficients of the harmonics.
        bits: number of bits of a value, at most 8; fewer take the same memory and show the loss.

    Returns:
        The leaves, and their losses.
    """
    steps = 2**bits - 1
    codes, table = packed_depths(depths, bits)
    low, high = _range(coefficients)
    scales = (high - low).clamp(min=1e-6) / steps
    colors = ((coefficients - low) / scales).round().clamp(0, steps).to(torch.uint8)
    leaves = PackedLeaves(codes, table, colors, scales, low)
    if not len(depths):
        return leaves, Rounding(0.0, 0.0)
    opacity = (torch.exp(-depths) - torch.exp(-leaves.depths())).square().mean().sqrt()
    color = (leaves.coefficients() - coefficients).square().mean().sqrt()
    return leaves, Rounding(float(opacity), 0.2821 * float(color))


def packed_depths(depths: Tensor, bits: int = 8) -> tuple[Tensor, Tensor]:
    """Return the codes (L,) uint8 of optical depths, and the table (256,) of the depths that codes stand for.

    Args:
        depths: (L,) optical depth of a cell's edge.
        bits: number of bits of a code, at most 8.
    """
    steps = 2**bits - 1
    share = depths.clamp(0, MAX_DEPTH) / (1 + depths.clamp(0, MAX_DEPTH))
    largest = float(share.max()) if len(share) else 0.0
    codes = (share * (steps / max(largest, 1e-6))).round().clamp(max=steps).to(torch.uint8)
    values = torch.arange(CODES, dtype=torch.float32, device=depths.device).clamp(max=steps) * (largest / steps)
    return codes, values / (1 - values)


def _range(coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """Return the quantiles (3 K,) that bound the stored coefficients (L, 3 K)."""
    count = len(coefficients)
    if not count:
        return coefficients.new_zeros(coefficients.shape[1]), coefficients.new_zeros(coefficients.shape[1])
    some = coefficients[:: -(-count // LOOKED_AT)].sort(0).values
    cut = int(CLIPPED * len(some))
    return some[cut].contiguous(), some[len(some) - 1 - cut].contiguous()
