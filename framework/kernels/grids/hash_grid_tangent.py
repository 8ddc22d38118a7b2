"""Multiresolution hash encoding with its derivative along a direction, for losses on gradients of a field.

A gradient n(x) of a scalar function of the encoding has a gradient of its own. With v the gradient of a loss by n, the
product v . n is the derivative along v, so the loss's gradients by table and network are gradients of a derivative
along a fixed direction. They need first derivatives only.
"""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.kernels import native
from nerfloom.kernels.dispatch import CPP, Operation
from nerfloom.kernels.grids.hash_grid import hash_grid_reference
from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from nerfloom.kernels.grids.hash_grid_lookup import LookUp, fits

_forward = native.Function("hash_grid_tangent_forward", "pqpippipi")
_backward_table = native.Function("hash_grid_tangent_backward_table", "pppiippipi")
_adam = native.Function("hash_grid_tangent_adam", "pppiippippppfddfi", "q")
LOOK_UP = LookUp("hash_grid_tangent", "points", ("N", 6), _forward, _backward_table, None, _adam, results=2)
"""The look-up of positions and directions."""


def hash_grid_tangent_reference(points: Tensor, table: Tensor, layout: HashGridLayout) -> Tensor:
    """Compute `hash_grid_tangent` of `points`, `table` and `layout` in PyTorch, with derivatives of any order."""
    # The gradient of weighted features is linear in the weights: its derivatives by them, along a direction, are the
    # derivatives of the features. The first use of PyTorch's forward mode would load decompositions, which takes
    # seconds.
    learns = torch.is_grad_enabled() and (points.requires_grad or table.requires_grad)
    with torch.enable_grad():
        positions = points[:, :3] if points.requires_grad else points[:, :3].detach().requires_grad_()
        features = hash_grid_reference(positions, table, layout)
        weights = torch.zeros_like(features, requires_grad=True)
        (slope,) = torch.autograd.grad(features, positions, weights, create_graph=True)
        (along,) = torch.autograd.grad(slope, weights, points[:, 3:], create_graph=learns)
    result = torch.cat([features, along], dim=-1)
    return result if learns else result.detach()


def hash_grid_tangent(points: Tensor, table: Tensor, layout: HashGridLayout) -> Tensor:
    """Return the hash encoding of positions, and its derivative along a direction at each.

    The result has no gradient in the compiled form.

    Args:
        points: (N, 6) positions, clamped to [0, 1], and directions of any length.
        table: (E, F) entries of all levels, E = layout.num_entries.
        layout: resolutions and offsets of the levels.

    Returns:
        (N, 2 * L * F): features level by level, followed by their derivatives along the directions.

    Raises:
        ValueError: if a shape does not fit the layout.
    """
    LOOK_UP.check(points, table, layout)
    return HASH_GRID_TANGENT((points, table), points, table, layout)


HASH_GRID_TANGENT = Operation("hash_grid_tangent", hash_grid_tangent_reference)


@HASH_GRID_TANGENT.implementation(CPP, order=0, differentiable=0, fits=fits)
def _compiled(points: Tensor, table: Tensor, layout: HashGridLayout) -> Tensor:
    points, table = points.contiguous(), table.contiguous()
    features = table.shape[1]
    out = points.new_empty(len(points), 2 * layout.num_levels * features)
    entries = native.pointer(table, "the hash table", (layout.num_entries, features))
    _forward(
        LOOK_UP.address(points), len(points), entries, features, *layout.arrays, layout.num_levels, out.data_ptr(),
        native.threads(),
    )  # fmt: skip
    return out
