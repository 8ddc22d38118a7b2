"""The hash grid of Zip-NeRF (Barron et al. 2023): means over points of conical frustums, with a normalised decay."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from nerfloom.base import device as devices
from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.kernels.grids.hash_grid_lookup import TableGradient
from nerfloom.kernels.grids.multisampled_grid import LOOK_UP, multisampled_grid

DECAYED = 8
"""On a CPU, one in this many frustums decays in a step, this many times as strongly, from a random start."""


class MultisampledHashGrid(HashGrid):
    """A multiresolution hash grid over [0, 1]^3 that is looked up at multisamples (`kernels.grids.multisamples`).

    Decay: the paper adds the mean square of each level's entries to the loss, so that the few entries of coarse levels
    decay as fast as the many entries of fine ones. The gradient of that term touches the whole table in each step. Here
    the term is the mean square of each level's features at the frustums of a step; its gradient reaches only entries
    that the step uses. An entry that is never used stays at its initial value of 1e-4 or less. On a CPU every eighth
    frustum stands for all, so that the others may have no gradient and look-ups can skip them.

    Args:
        num_levels, features_per_level, base_resolution, max_resolution, log2_table_size, sparse: as in `HashGrid`.
        decay: weight of the mean square of each level's features; its gradient is added in training mode.

    Raises:
        ConfigError: if a number is out of range, or the table needs more memory than the machine has.
    """

    def __init__(
        self,
        num_levels: int = 10,
        features_per_level: int = 4,
        base_resolution: int = 16,
        max_resolution: int = 8192,
        log2_table_size: int = 21,
        sparse: bool = False,
        decay: float = 0.0,
    ) -> None:
        super().__init__(num_levels, features_per_level, base_resolution, max_resolution, log2_table_size, sparse)
        self.deferred = TableGradient(LOOK_UP, self.layout) if sparse else None
        self.decay = decay

    def forward(self, points: Tensor) -> Tensor:
        """Return the features (N, L * F) of N sets of `points` (N, J, 4): positions in [0, 1] and deviations."""
        features = multisampled_grid(points, self.table, self.layout, self.deferred)
        if not (self.training and self.decay and torch.is_grad_enabled() and len(features)):
            return features
        return _Decayed.apply(features, 2 * self.decay * self.layout.num_levels / features.numel())


class _Decayed(torch.autograd.Function):
    """Identity; its gradient includes the gradient of half the sum of squares times a rate."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, rate: float) -> Tensor:
        ctx.save_for_backward(values)
        ctx.rate = rate
        return values.view_as(values)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        (values,) = ctx.saved_tensors
        if devices.runs_ahead(grad.device):  # a captured step would take the same rows each time
            return torch.add(grad, values, alpha=ctx.rate), None
        first, total = int(torch.randint(DECAYED, ())), grad.clone()
        total[first::DECAYED].add_(values[first::DECAYED], alpha=DECAYED * ctx.rate)
        return total, None
