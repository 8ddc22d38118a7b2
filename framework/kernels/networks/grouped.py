"""Many small networks of the same shape, each for some of the rows: KiloNeRF (Reiser et al. 2021), section 3.

The parameters of a network are one row of a table, so that a step can update only the networks that it used.

A network has too few rows for a matrix product of its own to be fast. The compiled kernel sorts rows by network, and
takes the rows of a network through all layers while its weights are in the cache. In PyTorch, rows are copied into
chunks of equal size, each with rows of one network, and one batched product multiplies all chunks. A chunk that is not
full is padded with zeros. In both forms a network without rows costs nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nerfloom.kernels import native, result_cache
from nerfloom.kernels.adam.deferred import waiting
from nerfloom.kernels.adam.row_gradient import RowGradient
from nerfloom.kernels.argument_checks import check_indices
from nerfloom.kernels.dispatch import CPP, Operation
from nerfloom.kernels.math import split_density
from nerfloom.kernels.networks.mlp import CODES, MAX_LAYERS, MAX_WIDTH, Activation

MIN_CHUNK, MAX_CHUNK = 4, 512
"""Minimum and maximum number of rows of a chunk."""


def parameter_count(widths: Sequence[int]) -> int:
    """Return the number P of parameters of a network.

    Args:
        widths: number of features of the input, of each hidden layer, and of the output.
    """
    return sum((before + 1) * after for before, after in pairwise(widths))


def layers_of(table: Tensor, widths: Sequence[int]) -> tuple[list[Tensor], list[Tensor]]:
    """Return views of the weights (C, D_out, D_in) and of the biases (C, D_out) of each layer of C networks.

    Args:
        table: (C, P) parameters of each network: for each layer the weights, row by row, and then the biases.
        widths: number of features of the input, of each hidden layer, and of the output.
    """
    sizes = [size for before, after in pairwise(widths) for size in (before * after, after)]
    parts = table.split(sizes, dim=1)
    shapes = [(after, before) for before, after in pairwise(widths)]
    return [weight.unflatten(1, shape) for weight, shape in zip(parts[::2], shapes, strict=True)], list(parts[1::2])


class Chunks(NamedTuple):
    """Places of N rows in C chunks of equal size."""

    places: Tensor
    """(N,) int64 place of each row, from 0 to C * size."""
    networks: Tensor
    """(C,) int64 network of each chunk."""
    size: int
    """Number of rows of a chunk."""


def chunks_of(owners: Tensor, count: int) -> Chunks:
    """Return chunks for the rows of networks; the rows of a network keep their order.

    The size is a power of two, about the mean number of rows of the networks that have some. Unless it is `MIN_CHUNK`
    or `MAX_CHUNK`, there are at most two chunks for each of these networks, and at most three places for each row.

    Args:
        owners: (N,) int64 network of each row.
        count: number of networks.
    """
    rows = torch.bincount(owners, minlength=count)
    busy = max(int((rows > 0).sum()), 1)
    size = min(max(1 << math.ceil(math.log2(max(len(owners) / busy, 1))), MIN_CHUNK), MAX_CHUNK)
    chunks = (rows + size - 1) // size
    networks = torch.repeat_interleave(torch.arange(count, device=owners.device), chunks)
    order = torch.argsort(owners, stable=True)
    first_rows, first_places = rows.cumsum(0) - rows, (chunks.cumsum(0) - chunks) * size
    # The row of rank r in the sorted order is the (r - first row)-th of its network.
    ahead = (first_places - first_rows).index_select(0, owners.index_select(0, order))
    places = torch.empty_like(order)
    places[order] = torch.arange(len(order), device=order.device) + ahead
    return Chunks(places, networks, size)


def grouped_mlp_reference(
    inputs: Sequence[Tensor], owners: Tensor, table: Tensor, widths: Sequence[int], activation: Activation = "none",
    deferred: RowGradient | None = None,
) -> Tensor:  # fmt: skip
    """Compute `grouped_mlp` in PyTorch, on any device and for any float type, with derivatives of any order.

    `inputs`, `owners`, `table`, `widths`, `activation` and `deferred` are as in `grouped_mlp`; `deferred` is not used.
    """
    check_indices(owners, len(table), "networks")
    places, networks, size = chunks_of(owners, len(table))
    x = torch.cat([part.to(table.dtype) for part in inputs], dim=-1)
    padded = x.new_zeros(len(networks) * size, x.shape[1]).index_copy(0, places, x)
    rows = padded.view(len(networks), size, x.shape[1])
    for layer, (weight, bias) in enumerate(zip(*layers_of(table, widths), strict=True)):
        rows = torch.relu(rows) if layer else rows
        own_weight, own_bias = (values.index_select(0, networks) for values in (weight, bias))
        rows = torch.bmm(rows, own_weight.transpose(1, 2)) + own_bias[:, None]
    out = rows.reshape(len(networks) * size, rows.shape[2]).index_select(0, places)
    if activation == "relu":
        return torch.relu(out)
    return torch.sigmoid(out) if activation == "sigmoid" else out


def grouped_density_mlp_reference(
    inputs: Sequence[Tensor], owners: Tensor, table: Tensor, widths: Sequence[int], deferred: RowGradient | None = None
) -> tuple[Tensor, Tensor]:
    """Compute `grouped_density_mlp` in PyTorch, on any device and for any float type.

    `inputs`, `owners`, `table`, `widths` and `deferred` are as in `grouped_density_mlp`; `deferred` is not used.
    """
    density, out = split_density(grouped_mlp_reference(inputs, owners, table, widths))
    return density, torch.cat([owners[:, None].to(out), out[:, 1:]], dim=-1)


def grouped_mlp(
    inputs: Sequence[Tensor], owners: Tensor, table: Tensor, widths: Sequence[int], activation: Activation = "none",
    deferred: RowGradient | None = None,
) -> Tensor:  # fmt: skip
    """Return the outputs of rows of many fully connected networks, with ReLU between their layers.

    Row n is the output of network `owners[n]`, as `mlp` computes it with the weights and biases of this network alone.
    The compiled form has first derivatives only, and multiplies in float32 under autocast too.

    Args:
        inputs: parts (N, D_i) of the input, treated as concatenated along the features.
        owners: (N,) int64 network of each row.
        table: (C, P) parameters of C networks, as in `layers_of`.
        widths: number of features of the input, of each hidden layer, and of the output.
        activation: activation function of the output.
        deferred: collects the gradient of the table, on compiled kernels; None to return it.

    Returns:
        (N, D_out) outputs.

    Raises:
        ValueError: if the widths do not fit the inputs or the table.
        IndexError: if a row's network does not exist.
    """
    _check_shapes(inputs, owners, table, widths)
    return GROUPED_NETWORK((*inputs, table), inputs, owners, table, widths, activation, deferred)


def grouped_density_mlp(
    inputs: Sequence[Tensor], owners: Tensor, table: Tensor, widths: Sequence[int], deferred: RowGradient | None = None
) -> tuple[Tensor, Tensor]:
    """Return the density (N,) and features (N, D_out) of networks with the log-density as first output.

    It equals `nerfloom.kernels.math.split_density` of `grouped_mlp`, except that the first feature is the number of the
    row's network, without a gradient, so that other networks of the same cells can follow. Numbers below 2^24 are
    exact. `inputs`, `owners`, `table`, `widths`, `deferred` and errors are as in `grouped_mlp`.
    """
    _check_shapes(inputs, owners, table, widths)
    return GROUPED_DENSITY_NETWORK((*inputs, table), inputs, owners, table, widths, deferred)


def _check_shapes(inputs: Sequence[Tensor], owners: Tensor, table: Tensor, widths: Sequence[int]) -> None:
    features = sum(part.shape[1] for part in inputs)
    if features != widths[0]:
        raise ValueError(f"grouped_mlp: networks of {widths[0]} features do not fit inputs of {features} features")
    if table.ndim != 2 or table.shape[1] != parameter_count(widths):
        wanted = f"(C, {parameter_count(widths)})"
        raise ValueError(f"grouped_mlp: the table has shape {tuple(table.shape)}, not {wanted} as its widths require")
    if any(len(part) != len(owners) for part in inputs):
        raise ValueError(f"grouped_mlp: there are networks for {len(owners)} rows, and inputs of other lengths")


GROUPED_NETWORK: Operation[..., Tensor] = Operation("grouped_mlp", grouped_mlp_reference)
GROUPED_DENSITY_NETWORK: Operation[..., tuple[Tensor, Tensor]] = Operation(
    "grouped_density_mlp", grouped_density_mlp_reference
)
_group = native.Function("group_rows", "pqqppp", "q")
_forward = native.Function("grouped_mlp_forward", "pppipppqppiippi")
_backward = native.Function("grouped_mlp_backward", "pppipppqppiipppppi")


class Groups(NamedTuple):
    """N rows sorted by network; T networks have rows."""

    order: Tensor
    """(N,) int64 rows, network by network."""
    networks: Tensor
    """(T,) int32 networks that have rows, in ascending order."""
    starts: Tensor
    """(T + 1,) int64 start of each network's rows in `order`, and N."""


def groups_of(owners: Tensor, count: int) -> Groups:
    """Return rows sorted by network, by compiled code; the rows of a network keep their order.

    Args:
        owners: (N,) int64 network of each row.
        count: number of networks.

    Raises:
        IndexError: if a row's network does not exist.
    """
    rows = len(owners)
    most = min(rows, count)
    order, networks = torch.empty(rows, dtype=torch.int64), torch.empty(most, dtype=torch.int32)
    starts = torch.empty(most + 1, dtype=torch.int64)
    used: int = _group(
        native.pointer(owners, "the networks of rows", (rows,), torch.int64), rows, count, order.data_ptr(),
        networks.data_ptr(), starts.data_ptr(),
    )  # fmt: skip
    return Groups(order, networks[:used], starts[: used + 1])


@dataclass(frozen=True)
class _Plan:
    widths: tuple[int, ...]
    activation: Activation
    density: bool


class _Call:
    """The arguments shared by forward and backward; it keeps the C arrays alive."""

    def __init__(self, plan: _Plan, groups: Groups, table: Tensor, inputs: Sequence[Tensor]) -> None:
        parts = tuple(part.shape[1] for part in inputs)
        self.arguments = (
            native.pointers([part.data_ptr() for part in inputs]), native.integers(parts),
            native.integers(tuple(part.stride(0) for part in inputs)), len(parts), groups.order.data_ptr(),
            groups.networks.data_ptr(), groups.starts.data_ptr(), len(groups.networks),
            native.pointer(table, "the networks", (len(table), parameter_count(plan.widths))),
            native.integers(plan.widths), len(plan.widths) - 1, CODES[plan.activation],
        )  # fmt: skip


class _Grouped(torch.autograd.Function):
    """The compiled form of `grouped_mlp`, or of `grouped_density_mlp` if the plan says so.

    Backward recomputes hidden layers, and skips rows with a gradient of 0.
    """

    @staticmethod
    def forward(
        ctx: Any, plan: _Plan, groups: Groups, owners: Tensor, table: Tensor, placeholder: Tensor | None,
        *inputs: Tensor,
    ) -> Tensor | tuple[Tensor, Tensor]:  # fmt: skip
        density: Tensor | None = None

        def compute() -> Tensor:
            nonlocal density
            out = table.new_empty(len(owners), plan.widths[-1])
            density = out.new_empty(len(owners)) if plan.density else None
            place = None if density is None else density.data_ptr()
            _forward(*_Call(plan, groups, table, inputs).arguments, out.data_ptr(), place, native.threads())
            return out

        def its_density() -> Tensor:
            if density is None:  # a recorded call computed the outputs
                compute()
            assert density is not None
            return density

        ctx.plan, ctx.groups = plan, groups
        ctx.set_materialize_grads(False)
        out = result_cache.result(("grouped_mlp", plan), (*inputs, owners), (table,), compute)
        if not plan.density:
            ctx.save_for_backward(table, *inputs)
            return out
        found = result_cache.result(("grouped_density",), (out,), (), its_density)
        ctx.save_for_backward(table, *inputs, found)
        return found, out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *incoming: Tensor | None) -> tuple[Tensor | None, ...]:
        plan, groups, (table, *inputs), density, of_density = ctx.plan, ctx.groups, ctx.saved_tensors, None, None
        if plan.density:
            (*inputs, density), (of_density, grad) = inputs, incoming
        else:
            (grad,) = incoming
        rows = len(groups.order)
        of_density, grad = (None if each is None else each.contiguous() for each in (of_density, grad))
        # New memory, because an input may be a part of a larger tensor's rows.
        grads = [
            part.new_empty(part.shape) if wanted else None
            for part, wanted in zip(inputs, ctx.needs_input_grad[5:], strict=True)
        ]
        of_networks = None
        if ctx.needs_input_grad[3] or ctx.needs_input_grad[4]:
            of_networks = table.new_empty(len(groups.networks), table.shape[1])
        _backward(
            *_Call(plan, groups, table, inputs).arguments,
            None if grad is None else native.pointer(grad, "the gradient", (rows, plan.widths[-1])),
            None if density is None else native.pointer(density, "the density", (rows,)),
            None if of_density is None else native.pointer(of_density, "the density's gradient", (rows,)),
            native.pointers([None if each is None else each.data_ptr() for each in grads]),
            None if of_networks is None else of_networks.data_ptr(), native.threads(),
        )  # fmt: skip
        of_table = None
        if ctx.needs_input_grad[3] and of_networks is not None:
            of_table = torch.zeros_like(table).index_copy_(0, groups.networks.long(), of_networks)
        return None, None, None, of_table, of_networks if ctx.needs_input_grad[4] else None, *grads


def _is_small(inputs: Sequence[Tensor], owners: Tensor, table: Tensor, widths: Sequence[int], *_: object) -> bool:
    return len(widths) <= MAX_LAYERS + 1 and max(widths) <= MAX_WIDTH


@GROUPED_NETWORK.implementation(CPP, fits=_is_small)
def _compiled(
    inputs: Sequence[Tensor], owners: Tensor, table: Tensor, widths: Sequence[int], activation: Activation = "none",
    deferred: RowGradient | None = None,
) -> Tensor:  # fmt: skip
    out: Tensor = _apply(_Plan(tuple(widths), activation, False), inputs, owners, table, deferred)
    return out


@GROUPED_DENSITY_NETWORK.implementation(CPP, fits=_is_small)
def _compiled_density(
    inputs: Sequence[Tensor], owners: Tensor, table: Tensor, widths: Sequence[int], deferred: RowGradient | None = None
) -> tuple[Tensor, Tensor]:
    density, features = _apply(_Plan(tuple(widths), "none", True), inputs, owners, table, deferred)
    return density, features


def _apply(
    plan: _Plan, inputs: Sequence[Tensor], owners: Tensor, table: Tensor, deferred: RowGradient | None
) -> Any:  # fmt: skip
    owners, table, placeholder = owners.contiguous(), table.contiguous(), None
    groups = groups_of(owners, len(table))
    if deferred is not None and table.requires_grad:
        placeholder = waiting(table, groups.networks, table.shape[1], deferred.parts)
        table = table.detach()
    return _Grouped.apply(plan, groups, owners, table, placeholder, *map(_with_adjacent_features, inputs))


def _with_adjacent_features(part: Tensor) -> Tensor:
    """Return an input with features that follow each other in memory; its rows may lie apart."""
    return part if part.stride(1) == 1 else part.contiguous()
