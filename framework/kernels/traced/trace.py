"""All waves of a march in one compiled call: marching, hash grid and density network of a block of rays.

`OccupancySampler` marches wave by wave, evaluates the field and ends rays without light. If the density is a small
network on a hash grid, `trace` does this (`trace_reference` is its readable form). The compiled form works block by
block in cache, without Python, copies or waits between waves (`kernels/traced/trace.cpp`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from nerfloom.kernels import native, result_cache
from nerfloom.kernels.dispatch import CPP, Operation
from nerfloom.kernels.encodings.contraction import contract_to_unit
from nerfloom.kernels.grids.hash_grid import HASH_GRID, hash_grid
from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from nerfloom.kernels.grids.hash_grid_lookup import TableGradient
from nerfloom.kernels.march.waves import CompiledMarch, March
from nerfloom.kernels.networks.mlp import DENSITY_NETWORK, density_mlp, multiplies_bf16
from nerfloom.kernels.rows import gather_rows

WAVES = (4, 4, 4, 4, 8, 16, 32, 128)
"""Samples per ray in each wave of a trace; the last size repeats. They start smaller than a march's waves: within one
call a wave costs next to nothing, and fewer samples behind a surface are evaluated."""

PATH, DENSITY = "ppppppqpipffppiif", "ppppippipip"
"""Types of the arguments of compiled traces that describe a march, and of the arguments that describe a density."""


@dataclass(frozen=True)
class GridDensity:
    """A density: `density_mlp` of `hash_grid` at position * scale + shift, or at the contracted position."""

    scale: Tensor
    """(3,) factor of positions in scene units."""
    shift: Tensor
    """(3,) shift added after scaling."""
    table: Tensor
    """(E, F) entries of all levels."""
    layout: HashGridLayout
    """Resolutions and offsets of the levels."""
    deferred: TableGradient | None
    """Collects the gradient of the table, as in `hash_grid`."""
    weights: Sequence[Tensor]
    """(D_out, D_in) weights of each layer, without biases."""
    box: Tensor | None = None
    """(2, 3) corners of the box of `contract_to_unit`, which contracts space around it; None without contraction."""

    def at(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Return the density (N,) and the outputs (N, D) of the network at `positions` (N, 3), scene units."""
        if self.box is None:
            unit = torch.addcmul(self.shift, positions, self.scale)
        else:
            unit = contract_to_unit(positions, self.box)
        return density_mlp((hash_grid(unit, self.table, self.layout, self.deferred),), self.weights)


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
    """(N, D) outputs of the network, with their gradient if gradients are enabled."""
    longest: int | None = None
    """Upper bound of the number of samples on a ray; None if computing it would take a pass over them."""


def trace(marched: March, density: GridDensity) -> Traced:
    """Return the samples of a march up to its early stop, with density and features.

    Args:
        marched: the march of R rays, before its first wave; the rays get no gradient.
        density: the density along the rays.
    """
    return TRACE((marched.rays.origins, density.table, *density.weights), marched, density)


def trace_reference(marched: March, density: GridDensity) -> Traced:
    """Compute `trace` of `marched` and `density` wave by wave, on any device."""
    evaluated = result_cache.Waves()
    while (wave := marched.wave(marched.next_limit)) is not None:
        marched.advance(evaluated.evaluate(len(wave.owners), partial(density.at, wave.positions))[0])
    order, offsets = marched.finish()
    waves = marched.waves
    if not waves:  # no occupied cell on any ray
        empty = marched.rays.nears[:0]
        return Traced(empty, empty, order, offsets, *density.at(marched.rays.origins[:0]))
    columns = [[w.t_starts for w in waves], [w.t_ends for w in waves], [w.owners for w in waves]]
    starts, ends, owners = gather_rows(columns, order)

    def chosen() -> tuple[Tensor, ...]:
        (positions,) = gather_rows([[w.positions for w in waves]], order)
        return density.at(positions)

    sigma, features = evaluated.choose(order, chosen)
    return Traced(starts, ends, owners, offsets, sigma, features, marched.longest)


TRACE = Operation("trace", trace_reference)


def is_compiled(marched: March, density: GridDensity) -> bool:
    """Return whether march, hash grid and network run compiled, with the required derivatives.

    Args:
        marched: the march, before its first wave.
        density: the density along its rays.
    """
    if not isinstance(marched, CompiledMarch) or marched.waves:
        return False
    return has_compiled_parts(marched.origins, density)


def has_compiled_parts(positions: Tensor, density: GridDensity) -> bool:
    """Return whether hash grid and network run compiled, with the required derivatives.

    Args:
        positions: (N, 3); their type and gradient matter.
        density: the density at the positions.
    """
    table, weights = density.table, density.weights
    grid = HASH_GRID.choose((positions, table), positions, table, density.layout, density.deferred)
    network = DENSITY_NETWORK.choose((positions, *weights), (positions,), weights)
    return grid.backend is CPP and network.backend is CPP and all(t.is_contiguous() for t in (table, *weights))


@TRACE.implementation(CPP, fits=is_compiled)
def _compiled(marched: March, density: GridDensity) -> Traced:
    rays, follows = len(marched.rays), torch.is_grad_enabled()
    total = _trace(*arguments(marched, density), multiplies_bf16(), follows, native.threads())
    starts, ends, sigma = (torch.empty(total) for _ in range(3))
    owners, offsets = torch.empty(total, dtype=torch.int64), torch.empty(rays + 1, dtype=torch.int64)
    unit, outputs = torch.empty(total, 3), torch.empty(total, density.weights[-1].shape[0])
    encoded = torch.empty(total, density.weights[0].shape[1]) if follows else None
    _take(
        rays, total, offsets.data_ptr(), starts.data_ptr(), ends.data_ptr(), owners.data_ptr(), unit.data_ptr(),
        None if encoded is None else encoded.data_ptr(), outputs.data_ptr(), sigma.data_ptr(), native.threads(),
    )  # fmt: skip
    if encoded is not None:  # the operations of these values add their gradients
        with result_cache.given(hash_grid=encoded, mlp=outputs, density=sigma):
            found = hash_grid(unit, density.table, density.layout, density.deferred)
            sigma, outputs = density_mlp((found,), density.weights)
    return Traced(starts, ends, owners, offsets, sigma, outputs)


def arguments(marched: March, density: GridDensity) -> tuple[Any, ...]:
    """Check the arguments of compiled traces and return them.

    Args:
        marched: the rays and their grid; `is_compiled` must hold.
        density: the density along the rays.
    """
    assert isinstance(marched, CompiledMarch)
    return (
        marched.origins.data_ptr(), marched.directions.data_ptr(), marched.enter.data_ptr(), marched.leave.data_ptr(),
        marched.first.data_ptr(), None if marched.slices is None else marched.slices.data_ptr(), len(marched.rays),
        native.integers(WAVES), len(WAVES), marched.box.data_ptr(), marched.step, marched.cone,
        marched.bits.data_ptr(), marched.blocks.data_ptr(), marched.resolution, marched.levels, marched.budget,
        *density_arguments(density),
    )  # fmt: skip


def density_arguments(density: GridDensity) -> tuple[Any, ...]:
    """Check the arguments of compiled calls that evaluate `density`, and return them."""
    layout, features, box = density.layout, density.table.shape[1], density.box
    return (
        native.pointer(density.scale, "the scale", (3,)), native.pointer(density.shift, "the shift", (3,)),
        None if box is None else native.pointer(box, "the box", (2, 3)),
        native.pointer(density.table, "the hash table", (layout.num_entries, features)), features, *layout.arrays,
        layout.num_levels, *network_arguments(density.weights),
    )  # fmt: skip


def network_arguments(weights: Sequence[Tensor]) -> tuple[Any, ...]:
    """Check a network's arguments of compiled traces, and return widths, number of layers and `weights`."""
    widths = (weights[0].shape[1], *(weight.shape[0] for weight in weights))
    shapes = [(widths[layer + 1], widths[layer]) for layer in range(len(weights))]
    checked = [native.pointer(weight, "weights", shape) for weight, shape in zip(weights, shapes, strict=True)]
    return native.integers(widths), len(weights), native.pointers(checked)


_trace: Callable[..., int] = native.Function("trace_rays", PATH + DENSITY + "iii", "q")
_take = native.Function("trace_take", "qqppppppppi")
