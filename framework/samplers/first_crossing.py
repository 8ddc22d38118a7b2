"""Sphere tracing (Hart 1996) of a signed distance: one sample a ray, where it first enters the surface.

A ray advances by the distance at its position, so it takes few steps far from a surface. It stays in occupied cells;
the space between them counts as outside. A learnt distance is no exact one: steps are shortened by its slope at the
position and by `SAFETY`, and a ray that has passed the surface is led back to it between its last two positions.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from nerfloom.base.step_kind import StepKind
from nerfloom.fields.base import DensityFunction, Field
from nerfloom.fields.surface import SurfaceField
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.rows import gather_rows
from nerfloom.samplers.base import Sampler
from nerfloom.samplers.occupancy import OccupancySampler

SAFETY = 1.25
"""Factor by which a learnt distance may be steeper on the way than at the position where it was evaluated."""
SHORTEST = 1 / 8
"""Shortest advance, in steps of the sampler; parts of a surface that are thicker along a ray are not passed over."""
REFINEMENTS = 3
"""Number of evaluations of a ray's distance to find the surface between two positions."""
DistanceFunction = Callable[[Tensor], Tensor]
"""Function from positions (N, 3) to signed distances (N,), none longer than that to the nearest surface."""


class Pieces(NamedTuple):
    """P pieces of R rays to be searched, sorted by ray and distance."""

    starts: Tensor
    """(P,) distance where each begins."""
    ends: Tensor
    """(P,) distance where each ends."""
    owners: Tensor
    """(P,) int64 index of its ray."""
    offsets: Tensor
    """(R + 1,) int64 index of each ray's first piece; the last entry is P."""


class _Places(NamedTuple):
    """The state of rays that are still advancing."""

    rays: Tensor
    """Index of each."""
    t: Tensor
    """Distance along it."""
    before: Tensor
    """Distance along it at the position before."""
    was: Tensor
    """Signed distance there; positive in space that is not searched, negative before the first position."""


def first_crossings(
    distance: DistanceFunction, rays: Rays, pieces: Pieces, shortest: float
) -> tuple[Tensor, Tensor, int]:
    """Return where rays first pass from outside to inside.

    A ray that starts inside has to leave first. Parts of a surface are passed over only if they are thinner along the
    ray than `shortest`, and if the distances are no longer than those to the nearest surface.

    Args:
        distance: computes distances.
        rays: R rays.
        pieces: where to search; elsewhere all space is outside.
        shortest: shortest advance, scene units.

    Returns:
        index (M,) of the rays that meet a surface, in ascending order; distances (M,) along them; and the number of
        evaluations.
    """
    counts = pieces.offsets[1:] - pieces.offsets[:-1]
    active = counts.nonzero().squeeze(-1)
    if not len(active):
        return active, rays.nears[:0], 0
    reach = float(pieces.ends.max()) + shortest  # one number orders ray and distance
    ends = pieces.owners * (2 * reach) + pieces.ends.double()
    first = pieces.starts[pieces.offsets[:-1][active]]
    # The first piece may begin at the face of the box, behind which is the outside, or at the ray's own start.
    was = torch.where(first > rays.nears[active] + shortest, 1.0, -1.0).to(first)
    here, found, evaluations = _Places(active, first, first, was), list[tuple[Tensor, ...]](), 0
    while len(here.rays):
        value = distance(rays.points(here.rays, here.t))
        evaluations += len(value)
        entered = (here.was > 0) & (value <= 0) | value.isnan()  # a broken field shows
        found.append(tuple(column[entered] for column in (here.rays, here.before, here.t, here.was, value)))
        going, t, value = (column[~entered] for column in (here.rays, here.t, value))
        to = t + value.abs().clamp(min=shortest)
        piece = torch.searchsorted(ends, going * (2 * reach) + to.double(), right=True)
        inside = piece < pieces.offsets[going + 1]
        going, t, value, to, piece = (column[inside] for column in (going, t, value, to, piece))
        gap = pieces.starts[piece] > to + shortest
        to = torch.maximum(to, pieces.starts[piece])
        here = _Places(going, to, torch.where(gap, to, t), torch.where(gap, torch.ones_like(value), value))
    owners, low, high, outside, inner = (torch.cat(columns) for columns in zip(*found, strict=True))
    at = _refined(distance, rays, owners, (low, high, outside, inner))
    order = owners.argsort()
    return owners[order], at[order], evaluations + REFINEMENTS * len(owners)


def _refined(distance: DistanceFunction, rays: Rays, owners: Tensor, bracket: tuple[Tensor, ...]) -> Tensor:
    """Return where distances are 0 (M,), by regula falsi (Illinois) between positions outside and inside.

    Args:
        distance, rays: as in `first_crossings`.
        owners: (M,) index of the rays.
        bracket: distances (M,) along the rays, outside and inside, and signed distances (M,) there.
    """
    low, high, outside, inside = bracket
    at = high
    for _ in range(REFINEMENTS):
        at = low + (high - low) * (outside / (outside - inside))
        value = distance(rays.points(owners, at))
        is_outside = value > 0
        # The end that stays counts half, so that both ends approach.
        outside = torch.where(is_outside, value, outside / 2)
        inside = torch.where(is_outside, inside / 2, value)
        low, high = torch.where(is_outside, at, low), torch.where(is_outside, high, at)
    return low + (high - low) * (outside / (outside - inside))


class FirstCrossing(Sampler):
    """Samples of another sampler, or in evaluation one opaque sample where a ray first enters the surface.

    Args:
        sampler: knows which cells are occupied.
        traces: whether pictures are traced; otherwise they have the other sampler's samples.
    """

    def __init__(self, sampler: OccupancySampler, traces: bool) -> None:
        super().__init__()
        self.sampler, self.traces, self.samples_per_step = sampler, traces, sampler.samples_per_step

    def sample(self, rays: Rays, field: Field, jitter: bool) -> Samples:
        if self.training or not self.traces:
            return self.sampler.sample(rays, field, jitter)
        assert isinstance(field, SurfaceField)
        with torch.no_grad():
            shortest = SHORTEST * self.sampler.step_size
            owners, t, _ = first_crossings(field.reach(SAFETY), rays, self.pieces(rays), shortest)
            counts = torch.bincount(owners, minlength=len(rays))
            offsets = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
            _, features = field.density(Points(rays.points(owners, t)))
        return Samples(t, t, offsets, owners=owners, longest=1).with_alpha(torch.ones_like(t), features)

    def pieces(self, rays: Rays) -> Pieces:
        """Return the steps of `rays` in occupied cells."""
        marched = self.sampler.begin(rays, False, 0.0)
        while (wave := marched.wave(marched.next_limit)) is not None:
            marched.advance(torch.zeros_like(wave.t_starts))
        order, offsets = marched.finish()
        if not (waves := marched.waves):
            return Pieces(rays.nears[:0], rays.nears[:0], order, offsets)
        columns = [[w.t_starts for w in waves], [w.t_ends for w in waves], [w.owners for w in waves]]
        return Pieces(*gather_rows(columns, order), offsets)

    def update(self, step: int, density: DensityFunction) -> None:
        """Update the other sampler."""
        self.sampler.update(step, density)

    def step_kind(self, step: int) -> StepKind:
        return self.sampler.step_kind(step)

    def read_counts(self) -> None:
        self.sampler.read_counts()

    def loss(self, samples: Samples, weights: Tensor) -> Tensor | None:
        return self.sampler.loss(samples, weights)
