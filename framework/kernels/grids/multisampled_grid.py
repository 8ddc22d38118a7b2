"""Hash encoding of conical frustums by a few points in each: Zip-NeRF (Barron et al. 2023), section 3.

The features of a frustum are the mean over its points. Each point is weighted per level with the fraction of its
Gaussian that lies within a cell (`level_weights`). The compiled form computes the mean during the look-up, so features
of single points are never stored.

Letters: N frustums, J points in each, L levels, F features of an entry.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from nerfloom.kernels import native
from nerfloom.kernels.dispatch import CPP, FEW_OPERATIONS, Operation
from nerfloom.kernels.grids.downweighting import level_weights
from nerfloom.kernels.grids.hash_grid import corners, hash_grid
from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from nerfloom.kernels.grids.hash_grid_lookup import LookUp, TableGradient, fits


def multisampled_grid_reference(
    points: Tensor, table: Tensor, layout: HashGridLayout, deferred: TableGradient | None = None
) -> Tensor:
    """Compute `multisampled_grid` of `points`, `table` and `layout` in PyTorch; `deferred` is not used."""
    positions, deviations = points[..., :3].flatten(0, 1), points[..., 3].detach().flatten()
    shares = level_weights(deviations, _resolutions(layout, points.dtype, points.device)).to(table.dtype)
    features = []
    for level, offset in enumerate(layout.offsets[:-1]):
        entries, weights, _ = corners(positions, layout, level)
        found = (table[entries.long() + offset] * (weights * shares[:, level])[..., None]).sum(0)
        features.append(found.view(*points.shape[:2], -1).mean(1))
    return torch.cat(features, dim=-1)


@lru_cache(maxsize=64)
def _resolutions(layout: HashGridLayout, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return cells along an axis (L,); cached, because a copy to the device waits for it."""
    return torch.tensor(layout.resolutions, dtype=dtype, device=device)


_forward = native.Function("multisampled_grid_forward", "pqipippipi")
_backward_table = native.Function("multisampled_grid_backward_table", "ppppiippipi")
_backward_points = native.Function("multisampled_grid_backward_points", "pqippippipi")
_adam = native.Function("multisampled_grid_adam", "ppppiippippppfddfi", "q")
LOOK_UP = LookUp("multisampled_grid", "points", ("N", "J", 4), _forward, _backward_table, _backward_points, _adam)
"""The look-up of frustums."""


def multisampled_grid(
    points: Tensor, table: Tensor, layout: HashGridLayout, deferred: TableGradient | None = None
) -> Tensor:
    """Return the hash encoding of frustums: the mean over their points of features weighted by scale.

    The compiled form has first derivatives only.

    Args:
        points: (N, J, 4) positions, clamped to [0, 1], and standard deviations in units of the cube; the deviations get
            no gradient.
        table: (E, F) entries of all levels, E = layout.num_entries.
        layout: resolutions and offsets of the levels.
        deferred: collects the gradient of the table in the compiled form, instead of autograd; None for autograd.

    Returns:
        (N, L * F) features of the type of `table`, level by level.

    Raises:
        ValueError: if a shape does not fit the layout.
    """
    LOOK_UP.check(points, table, layout)
    points = points.to(table.dtype)
    return MULTISAMPLED_GRID((points, table), points, table, layout, deferred)


MULTISAMPLED_GRID: Operation[..., Tensor] = Operation(LOOK_UP.name, multisampled_grid_reference)
MULTISAMPLED_GRID.implementation(CPP, fits=fits)(LOOK_UP.compiled)


@MULTISAMPLED_GRID.implementation(FEW_OPERATIONS, types=None, order=torch.inf)
def _by_points(points: Tensor, table: Tensor, layout: HashGridLayout, deferred: TableGradient | None) -> Tensor:
    """Compute `multisampled_grid` by the plain look-up of all points, which has kernels on GPUs."""
    positions, deviations = points[..., :3].flatten(0, 1).contiguous(), points[..., 3].detach().flatten()
    shares = level_weights(deviations, _resolutions(layout, points.dtype, points.device)).to(table.dtype)
    features = hash_grid(positions, table, layout) * shares.repeat_interleave(table.shape[1], dim=-1)
    return features if points.shape[1] == 1 else features.view(*points.shape[:2], features.shape[-1]).mean(1)
