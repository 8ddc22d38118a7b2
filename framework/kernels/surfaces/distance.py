"""A network on a hash grid, with a differentiable gradient of its first output.

The network has one hidden layer with ReLU, as in NeuS2 (Wang et al. 2023). The second derivative of ReLU is 0 almost
everywhere. With features e(x) of the grid, h = W1 e, active units m = [h > 0] and outputs y = W2 (m h):

    dy_0 / de = W1^T (m w),      w the first row of W2
    n = dy_0 / dx = (de / dx)^T W1^T (m w)

A loss with the gradients dy for y and v for n has the gradients of dy . y + (dy_0 / dx) . v. With t = (de / dx) v:

    by W2:  dy (m h)^T, and m W1 t added to the first row
    by W1:  (m W2^T dy) e^T + (m w) t^T
    by e:   W1^T (m W2^T dy)            by t:  W1^T (m w)

By the position x, the outputs have the gradient of e (`following_positions`). The derivative of n needs the grid's
second derivative, which is 0 along the axes and jumps at the faces of cells.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from nerfloom.kernels import native, result_cache
from nerfloom.kernels.dispatch import CPP, FEW_OPERATIONS, TRITON, Operation, derivatives
from nerfloom.kernels.grids.hash_grid import LOOK_UP, hash_grid, hash_grid_reference
from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from nerfloom.kernels.grids.hash_grid_lookup import TableGradient
from nerfloom.kernels.grids.hash_grid_tangent import LOOK_UP as TANGENT
from nerfloom.kernels.triton_backend import later


def distance_network_reference(
    positions: Tensor, table: Tensor, first: Tensor, second: Tensor, layout: HashGridLayout,
    deferred: TableGradient | None = None,
) -> Tensor:  # fmt: skip
    """Compute `distance_network` in PyTorch, for any device and float type, with derivatives of any order.

    `positions`, `table`, `first`, `second`, `layout` and the result are as there; `deferred` is not used.
    """
    return _with_gradient(hash_grid_reference, positions, table, first, second, layout)


def _with_gradient(
    look_up: Callable[[Tensor, Tensor, HashGridLayout], Tensor], positions: Tensor, table: Tensor, first: Tensor,
    second: Tensor, layout: HashGridLayout,
) -> Tensor:  # fmt: skip
    """Compute `distance_network` by autograd through a form of the grid with the needed derivatives."""
    learns = torch.is_grad_enabled()
    # Not in bfloat16: its 8 bits are too few for distances near the surface.
    with torch.enable_grad(), torch.autocast(positions.device.type, enabled=False):
        positions = positions if positions.requires_grad else positions.detach().requires_grad_()
        out = torch.relu(look_up(positions, table, layout) @ first.t()) @ second.t()
        (gradient,) = torch.autograd.grad(out[:, 0].sum(), positions, create_graph=learns)
    result = torch.cat([out, gradient], dim=-1)
    return result if learns else result.detach()


def distance_network(
    positions: Tensor, table: Tensor, first: Tensor, second: Tensor, layout: HashGridLayout,
    deferred: TableGradient | None = None,
) -> Tensor:  # fmt: skip
    """Return the outputs of a network on a hash grid, and the gradient of the first one by the position.

    The compiled form has the gradients of both by table and network. Positions that require a gradient take the
    reference.

    Args:
        positions: (N, 3); coordinates are clamped to [0, 1], where the gradient is 0.
        table: (E, F) entries of all levels.
        first: (H, L * F) weights of the hidden layer.
        second: (D, H) weights of the output.
        layout: resolutions and offsets of the levels.
        deferred: collects the gradient of the table in the compiled form, instead of autograd; None for autograd.

    Returns:
        (N, D + 3): the outputs, followed by the gradient of the first.

    Raises:
        ValueError: if a shape does not fit the layout.
    """
    LOOK_UP.check(positions, table, layout)
    if first.shape[1] != layout.num_levels * table.shape[1] or second.shape[1] != len(first):
        sizes = " and ".join(str(tuple(each.shape)) for each in (first, second))
        raise ValueError(f"distance_network: weights of {sizes} do not fit {layout.num_levels} levels")
    return DISTANCE_NETWORK((positions, table, first, second), positions, table, first, second, layout, deferred)


def following_positions(
    positions: Tensor, table: Tensor, first: Tensor, second: Tensor, layout: HashGridLayout
) -> Tensor:
    """Return zeros (N, D + 3) that have the gradient of a network's outputs by the position.

    Added to `distance_network` of positions without a gradient, they give it that gradient, in the compiled form too.
    The gradient of the first output by the position counts as constant.

    Args:
        positions: (N, 3); coordinates are clamped to [0, 1], where the gradient is 0.
        table, first, second, layout: as in `distance_network`.
    """
    with torch.autocast(positions.device.type, enabled=False):  # as the outputs themselves
        hidden = torch.relu(hash_grid(positions, table.detach(), layout) @ first.detach().t())
        outputs = hidden @ second.detach().t()
    return torch.nn.functional.pad(outputs - outputs.detach(), (0, 3))


def _fits(positions: Tensor, table: Tensor, *network: Any, **named: Any) -> bool:
    return table.shape[1] in (1, 2, 4, 8) and not (positions.requires_grad and torch.is_grad_enabled())


DISTANCE_NETWORK = Operation("distance_network", distance_network_reference)
_forward = native.Function("distance_network_forward", "pqpippipipipi")
_backward = native.Function("distance_network_backward", "ppqpippipipipppi")
DISTANCE_NETWORK.implementation(TRITON, fits=_fits)(later("surfaces.distance_triton", "distance_network"))


@DISTANCE_NETWORK.implementation(FEW_OPERATIONS, types=None, order=torch.inf)
def _few_operations(
    positions: Tensor, table: Tensor, first: Tensor, second: Tensor, layout: HashGridLayout,
    deferred: TableGradient | None = None,
) -> Tensor:  # fmt: skip
    with derivatives(2):  # a loss on the gradient of the distance needs the grid's second derivatives
        return _with_gradient(hash_grid, positions, table, first, second, layout)


@DISTANCE_NETWORK.implementation(CPP, fits=_fits)
def _compiled(
    positions: Tensor, table: Tensor, first: Tensor, second: Tensor, layout: HashGridLayout,
    deferred: TableGradient | None = None,
) -> Tensor:  # fmt: skip
    contiguous = positions.contiguous(), table.contiguous(), first.contiguous(), second.contiguous()
    return _DistanceNetwork.apply(*contiguous, layout, deferred)


class _DistanceNetwork(torch.autograd.Function):
    """The compiled form, with the gradients of the module's head."""

    @staticmethod
    def forward(
        ctx: Any, positions: Tensor, table: Tensor, first: Tensor, second: Tensor, layout: HashGridLayout,
        deferred: TableGradient | None,
    ) -> Tensor:  # fmt: skip
        ctx.save_for_backward(positions, table, first, second)
        ctx.layout, ctx.deferred = layout, deferred

        def compute() -> Tensor:
            out = positions.new_empty(len(positions), len(second) + 3)
            _forward(
                native.pointer(positions, "positions", (len(positions), 3)), len(positions),
                *_network(table, first, second, layout), out.data_ptr(), native.threads(),
            )  # fmt: skip
            return out

        return result_cache.result(("distance_network", layout), (positions,), (table, first, second), compute)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        positions, table, first, second = ctx.saved_tensors
        layout, deferred, grad = ctx.layout, ctx.deferred, grad.contiguous()
        points = torch.cat([positions, grad[:, len(second) :]], dim=-1)
        of_encoding = points.new_empty(len(points), 2 * first.shape[1])
        of_first, of_second = torch.empty_like(first), torch.empty_like(second)
        _backward(
            points.data_ptr(), native.pointer(grad, "the gradient", (len(points), len(second) + 3)), len(points),
            *_network(table, first, second, layout), of_encoding.data_ptr(), of_first.data_ptr(),
            of_second.data_ptr(), native.threads(),
        )  # fmt: skip
        of_table = None
        if ctx.needs_input_grad[1]:
            collected = TableGradient(TANGENT, layout) if deferred is None else deferred
            collected.parts.append((points, of_encoding))
            if deferred is None:
                of_table = torch.zeros_like(table)
                collected.add_to(of_table)
        return None, of_table, of_first, of_second, None, None


def _network(table: Tensor, first: Tensor, second: Tensor, layout: HashGridLayout) -> tuple[Any, ...]:
    """Return the arguments of the compiled functions that describe the network."""
    entries = native.pointer(table, "the hash table", (layout.num_entries, table.shape[1]))
    return (
        entries, table.shape[1], *layout.arrays, layout.num_levels, native.pointer(first, "first weights", first.shape),
        len(first), native.pointer(second, "second weights", second.shape), len(second),
    )  # fmt: skip
