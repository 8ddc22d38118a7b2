"""Many small networks of the same shape, each for some of the rows: KiloNeRF (Reiser et al. 2021), section 3.

A network has too few rows for a matrix product of its own to be fast. So rows are brought to places in chunks of equal
size, each of rows of one network, and all chunks are multiplied in one batched product. A chunk that is not full is
padded with zeros, and a network without rows has no chunk.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from nerfloom.kernels.argument_checks import check_indices
from nerfloom.kernels.dispatch import Operation
from nerfloom.kernels.networks.mlp import Activation

MIN_CHUNK, MAX_CHUNK = 4, 512
"""Minimum and maximum number of rows of a chunk."""


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
    inputs: Sequence[Tensor],
    owners: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    activation: Activation = "none",
) -> Tensor:
    """Compute `grouped_mlp` in PyTorch, on any device and for any float type, with derivatives of any order.

    `inputs`, `owners`, `weights`, `biases` and `activation` are as in `grouped_mlp`.
    """
    count = len(weights[0])
    check_indices(owners, count, "networks")
    places, networks, size = chunks_of(owners, count)
    x = torch.cat([part.to(weights[0].dtype) for part in inputs], dim=-1)
    padded = x.new_zeros(len(networks) * size, x.shape[1]).index_copy(0, places, x)
    rows = padded.view(len(networks), size, x.shape[1])
    for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        rows = torch.relu(rows) if layer else rows
        own_weight, own_bias = (values.index_select(0, networks) for values in (weight, bias))
        rows = torch.bmm(rows, own_weight.transpose(1, 2)) + own_bias[:, None]
    out = rows.reshape(len(networks) * size, rows.shape[2]).index_select(0, places)
    if activation == "relu":
        return torch.relu(out)
    return torch.sigmoid(out) if activation == "sigmoid" else out


def grouped_mlp(
    inputs: Sequence[Tensor],
    owners: Tensor,
    weights: Sequence[Tensor],
    biases: Sequence[Tensor],
    activation: Activation = "none",
) -> Tensor:
    """Return the outputs of rows of many fully connected networks, with ReLU between their layers.

    Row n is the output of network `owners[n]`, as `mlp` computes it with the weights and biases of this network alone.

    Args:
        inputs: parts (N, D_i) of the input, treated as concatenated along the features.
        owners: (N,) int64 network of each row.
        weights: (C, D_out, D_in) weights of each layer of C networks.
        biases: (C, D_out) biases of each layer.
        activation: activation function of the output.

    Returns:
        (N, D_out) outputs.

    Raises:
        ValueError: if the widths of inputs and layers, or the numbers of networks, do not fit.
        IndexError: if a row's network does not exist.
    """
    _check_shapes(inputs, owners, weights, biases)
    return GROUPED_NETWORK((*inputs, *weights, *biases), inputs, owners, weights, biases, activation)


def _check_shapes(
    inputs: Sequence[Tensor], owners: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor]
) -> None:
    count, widths = len(weights[0]), [sum(part.shape[1] for part in inputs), *(bias.shape[1] for bias in biases)]
    expected = [(count, after, before) for before, after in pairwise(widths)]
    found = [tuple(weight.shape) for weight in weights]
    if found != expected or any(len(bias) != count for bias in biases):
        shapes = ", ".join(map(str, found))
        raise ValueError(f"grouped_mlp: weights of shapes {shapes} do not fit inputs of {widths[0]} features")
    if any(len(part) != len(owners) for part in inputs):
        raise ValueError(f"grouped_mlp: there are networks for {len(owners)} rows, and inputs of other lengths")


GROUPED_NETWORK = Operation("grouped_mlp", grouped_mlp_reference)
