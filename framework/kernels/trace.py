"""All waves of a march in one compiled call: marching, hash grid and density network of a block of rays.

`OccupancySampler` marches wave by wave, evaluates the field and ends rays whose light is spent. That loop is the
readable form, for any field and device. Where the density is a small network on a hash grid, `trace` returns what the
loop would, computed block by block in cache, without Python, copies and waiting between waves (`csrc/trace.cpp`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from framework.kernels import kept, native
from framework.kernels.dispatch import CPP
from framework.kernels.hash_grid import HASH_GRID, HashGridLayout, hash_grid
from framework.kernels.hash_grid_lookup import TableGradient
from framework.kernels.march import WAVES, CompiledMarch, March
from framework.kernels.mlp import DENSITY_NETWORK, density_mlp, multiplies_bf16


@dataclass(frozen=True)
class GridDensity:
    """A density at positions: `density_mlp` of `hash_grid` at position * scale + shift."""

    scale: Tensor
    """(3,) factor of positions in scene units."""
    shift: Tensor
    """(3,) what is added to these."""
    table: Tensor
    """(E, F) entries of all levels."""
    layout: HashGridLayout
    """Resolutions and offsets of the levels."""
    deferred: TableGradient | None
    """Collects the gradient of the table, as in `hash_grid`."""
    weights: Sequence[Tensor]
    """(D_out, D_in) weights of each layer, without biases."""


@dataclass(frozen=True)
class Traced:
    """N samples of R rays that light reached, ray by ray."""

    t_starts: Tensor
    """(N,) distance at the start of each interval."""
    t_ends: Tensor
    """(N,) distance at the end of each interval."""
    owners: Tensor
    """(N,) int64 index of the ray of each sample."""
    offsets: Tensor
    """(R + 1,) int64 index of each ray's first sample."""
    sigma: Tensor
    """(N,) density, with its gradient if gradients are enabled."""
    features: Tensor
    """(N, D) outputs of the network, likewise."""


def trace(marched: March, density: GridDensity) -> Traced | None:
    """Return the samples of a march that has just begun, up to its early stop, with density and features.

    Args:
        marched: the march, before its first wave.
        density: the density along the rays.

    Returns:
        What waves would give; None where march, hash grid or network would not run compiled, or if positions are to
        have a gradient, so that the caller has to go wave by wave.
    """
    if not isinstance(marched, CompiledMarch) or marched.waves or not is_compiled(marched.origins, density):
        return None
    rays, layout, follows = len(marched.rays), density.layout, torch.is_grad_enabled()
    total = _trace(*arguments(marched, density), multiplies_bf16(), follows, native.threads())
    starts, ends, sigma = (torch.empty(total) for _ in range(3))
    owners, offsets = torch.empty(total, dtype=torch.int64), torch.empty(rays + 1, dtype=torch.int64)
    unit, outputs = torch.empty(total, 3), torch.empty(total, density.weights[-1].shape[0])
    encoded = torch.empty(total, density.weights[0].shape[1]) if follows else None
    _take(
        rays, total, offsets.data_ptr(), starts.data_ptr(), ends.data_ptr(), owners.data_ptr(), unit.data_ptr(),
        None if encoded is None else encoded.data_ptr(), outputs.data_ptr(), sigma.data_ptr(), native.threads(),
    )  # fmt: skip
    if encoded is not None:  # the operations that made these values add their gradients
        with kept.given(hash_grid=encoded, mlp=outputs, density=sigma):
            found = hash_grid(unit, density.table, layout, density.deferred)
            sigma, outputs = density_mlp((found,), density.weights)
    return Traced(starts, ends, owners, offsets, sigma, outputs)


def arguments(marched: CompiledMarch, density: GridDensity) -> tuple[Any, ...]:
    """Return the arguments of compiled traces: the rays, their grid, and the density along them, checked."""
    layout, features = density.layout, density.table.shape[1]
    return (
        marched.origins.data_ptr(), marched.directions.data_ptr(), marched.enter.data_ptr(), marched.leave.data_ptr(),
        marched.first.data_ptr(), None if marched.slices is None else marched.slices.data_ptr(), len(marched.rays),
        native.integers(WAVES), len(WAVES), marched.box.data_ptr(), marched.step, marched.cone,
        marched.bits.data_ptr(), marched.blocks.data_ptr(), marched.resolution, marched.levels, marched.budget,
        native.pointer(density.scale, "the scale", (3,)), native.pointer(density.shift, "the shift", (3,)),
        native.pointer(density.table, "the hash table", (layout.num_entries, features)), features, *layout.arrays,
        layout.num_levels, *network(density.weights),
    )  # fmt: skip


def network(weights: Sequence[Tensor]) -> tuple[Any, ...]:
    """Return the arguments of a network of compiled traces: widths, number of layers, and `weights`, checked."""
    widths = (weights[0].shape[1], *(weight.shape[0] for weight in weights))
    pointers = [
        native.pointer(weight, "weights", (widths[layer + 1], widths[layer])) for layer, weight in enumerate(weights)
    ]
    return native.integers(widths), len(weights), native.pointers(pointers)


def is_compiled(origins: Tensor, density: GridDensity) -> bool:
    """Return whether hash grid and network would run compiled, with the derivatives that are asked for.

    Args:
        origins: (R, 3) origins of the rays along which the density is.
        density: the density.
    """
    table, weights = density.table, density.weights
    grid = HASH_GRID.choose((origins, table), origins, table, density.layout, density.deferred)
    inputs = (origins,)
    network = DENSITY_NETWORK.choose((*inputs, *weights), inputs, weights)
    return grid.backend is CPP and network.backend is CPP and all(t.is_contiguous() for t in (table, *weights))


_trace: Callable[..., int] = native.Function("trace_rays", "ppppppqpipffppiifpppippipipiii", "q")
_take = native.Function("trace_take", "qqppppppppi")
