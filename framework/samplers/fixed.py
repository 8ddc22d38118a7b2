"""Samples of an occupancy grid in a fixed number of slots, for devices that run ahead of Python."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from nerfloom.fields.base import HasAlpha
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.compositing.alpha import alpha_depth
from nerfloom.kernels.march.fixed_slots import Placed, fill, longest_ray, reach
from nerfloom.kernels.march.occupancy import Occupancy
from nerfloom.kernels.march.waves import Wave
from nerfloom.samplers.sample_capacity import SampleCapacity

MIN_LENGTH = 1e-10
"""Divisor for the optical depth of an empty slot, scene units."""


class Steps(NamedTuple):
    """Steps of rays through a grid, in the form of `nerfloom.kernels.march.fixed_slots.fill`."""

    occupancy: Occupancy
    """The grid, of one box."""
    size: float
    """Length of a step, scene units."""
    number: int
    """Number of steps along the diagonal of the box."""
    shift: Tensor | None
    """(R,) fraction of the first step that is before the box; None for 0."""


def sample_into_slots(
    rays: Rays,
    steps: Steps,
    capacity: SampleCapacity,
    evaluate: Callable[[Wave], tuple[Tensor, Tensor]],
    surface: HasAlpha | None,
    early_stop: float,
    usual: int | None = None,
) -> Samples:
    """Return samples in occupied cells, up to the early stop, without waiting for the device.

    The density is evaluated at all candidates, and again, with gradient, at candidates that light reaches. The sizes
    that the step needed are recorded in `capacity`.

    Args:
        rays: R rays, R > 0.
        steps: the steps along them.
        capacity: numbers of slots.
        evaluate: density or opacity, and features, of intervals.
        surface: the field, if it has opacities.
        early_stop: transmittance below which the rest of a ray is dropped.
        usual: target number of samples per step; None without a target.
    """
    count, sizes = len(rays), capacity.of(len(rays), usual)
    with torch.no_grad():
        found = fill(rays, *steps, (sizes.runs, sizes.candidates))
        placed = found.placed
        stopping = evaluate(_wave(rays, placed))[0]
        if surface is not None:  # the density that gives the same opacity in each interval
            stopping = alpha_depth(stopping) / (placed.t_ends - placed.t_starts).clamp(min=MIN_LENGTH)
        reached = reach(placed, stopping, early_stop, steps.number)
        kept = placed.first(reached, sizes.kept)
        slots, filled = kept.slots, kept.slots.counts.sum()
        capacity.note(count, (found.runs, found.candidates, reached.sum()), found.left_out + slots.left_out)
    wave, longest = _wave(rays, kept), longest_ray(slots, steps.number)
    stopping, features = evaluate(wave)
    if surface is not None:
        stopping = torch.where(wave.t_ends > wave.t_starts, stopping, 0)
    samples = Samples(
        wave.t_starts,
        wave.t_ends,
        slots.offsets,
        owners=slots.owners,
        longest=longest,
        filled=filled,
        early_stop=early_stop,
    )
    return attached(samples, surface, stopping, features)


def attached(samples: Samples, surface: HasAlpha | None, stopping: Tensor, features: Tensor) -> Samples:
    """Return `samples` with `features` (N, F), and with `stopping` (N,): density, or opacity of a `surface`."""
    return samples.evaluated(stopping, features) if surface is None else samples.with_alpha(stopping, features)


def _wave(rays: Rays, placed: Placed) -> Wave:
    """Return intervals in slots, with their positions on `rays`."""
    owners = placed.slots.owners
    return Wave(placed.t_starts, placed.t_ends, owners, rays.points(owners, (placed.t_starts + placed.t_ends) / 2))
