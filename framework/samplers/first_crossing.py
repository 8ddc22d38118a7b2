"""Sphere tracing of a signed distance (Hart 1996): samples where rays meet surfaces, up to one that covers the ray.

A ray advances by the distance at its position, so it takes few steps far from a surface. It stays in occupied cells;
the space between them counts as outside. A learnt distance is not exact. So steps are divided by `SAFETY` and by its
slope at the position, if above 1. If a ray has passed the surface, the crossing is found between its last two
positions.

A pixel is a cone. Let m be the minimum distance of a ray that passes a surface, and r the cone's radius there. If the
surface's edge is straight, it covers (r - m) / (2 r) of the cone. So edges are smooth with one ray per pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from nerfloom.fields.base import Field
from nerfloom.fields.surface import SurfaceField
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.rows import gather_rows
from nerfloom.samplers.occupancy import OccupancySampler
from nerfloom.samplers.wrapping import WrappingSampler

SAFETY = 1.25
"""Maximum slope of a learnt distance along a step, relative to its slope at the position where it was evaluated."""
SHORTEST = 1 / 8
"""Minimum advance, in steps of the sampler."""
REFINEMENTS, EXACT = 8, 1e-3
"""Maximum number of evaluations to find the surface between two positions, and the distance from it that is accepted,
in minimum advances."""
DistanceFunction = Callable[[Tensor], Tensor]
"""Function from positions (N, 3) to signed distances (N,), at most the true distance to the nearest surface."""


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


class Crossings(NamedTuple):
    """M positions where rays meet a surface, sorted by ray and distance."""

    owners: Tensor
    """(M,) int64 index of the ray."""
    t: Tensor
    """(M,) distance where it enters, or where it is nearest to a surface that it passes."""
    coverage: Tensor
    """(M,) share of the ray's cone that the surface covers."""
    evaluations: int
    """Number of evaluations of the distance."""


class _Paths(NamedTuple):
    """The state of rays that are still advancing, one column per quantity."""

    rays: Tensor
    """Index."""
    t: Tensor
    """Distance along the ray."""
    before: Tensor
    """Distance along the ray at the previous position."""
    was: Tensor
    """Signed distance there; positive in space that is not searched, negative before the first position."""
    least: Tensor
    """Minimum distance since the ray was last clear of a surface; -infinity if it has never been."""
    nearest: Tensor
    """Distance along the ray at that position."""
    outside: Tensor
    """Distance along the ray of the last position before it entered; negative if it has not."""
    inside: Tensor
    """Distance along the ray of the first position after it entered."""
    value_outside: Tensor
    """Signed distance at `outside`."""
    value_inside: Tensor
    """Signed distance at `inside`."""

    def of(self, chosen: Tensor) -> _Paths:
        """Return the rays that `chosen`, a mask, selects."""
        index = chosen.nonzero().squeeze(-1)
        return _Paths(*(column.index_select(0, index) for column in self))


def crossings(distance: DistanceFunction, rays: Rays, pieces: Pieces, shortest: float) -> Crossings:
    """Return where rays meet surfaces, up to the first that covers them.

    A ray that starts inside has to leave first. If the distances do not exceed those to the nearest surface, only parts
    of a surface are missed that are thinner along the ray than the larger of `shortest` and half of the cone's radius.

    Args:
        distance: computes distances.
        rays: R rays; without `pixel_radii` a surface covers all of a ray or nothing.
        pieces: where to search; elsewhere all space is outside.
        shortest: minimum advance, scene units.
    """
    active = (pieces.offsets[1:] > pieces.offsets[:-1]).nonzero().squeeze(-1)
    radii = torch.zeros_like(rays.nears) if rays.pixel_radii is None else rays.pixel_radii
    first = pieces.starts[pieces.offsets[:-1][active]]
    # The first piece may begin at the face of the box, behind which is the outside, or at the ray's own start.
    was = torch.where(first > rays.nears[active] + shortest, 1.0, -1.0).to(first)
    unclear = torch.full_like(first, -torch.inf)
    paths = _Paths(active, first, first, was, was * torch.inf, first, unclear, first, first, first)
    span = 2 * (float(pieces.ends.max()) + shortest) if len(active) else 1.0  # one number orders ray and distance
    ends = pieces.owners * span + pieces.ends.double()
    met, evaluations = [(paths.of(active < 0), first[:0])], 0
    while len(paths.rays):
        value = distance(rays.points(paths.rays, paths.t))
        evaluations += len(value)
        radius = radii[paths.rays] * paths.t
        paths = _noted(paths, value)
        covered = (paths.outside > -torch.inf) & (paths.least <= -radius) | value.isnan()  # a broken field shows
        # At least a few units in the last place, so that a ray far away ends too.
        step = value.abs().clamp(min=shortest).maximum(radius / 2).maximum(4 * torch.finfo(value.dtype).eps * paths.t)
        to = paths.t + step
        piece = torch.searchsorted(ends, paths.rays * span + to.double(), right=True)
        over = piece >= pieces.offsets[paths.rays + 1]
        start = pieces.starts[piece.clamp(max=len(ends) - 1)]
        gap = ~over & (start > to + shortest)
        clear = (value > radius) | over | gap
        meets = covered | clear & (paths.least < radius) & (paths.least > -torch.inf)
        share = torch.where(covered, 1.0, (0.5 - 0.5 * paths.least / radius).clamp(max=1))
        met.append((paths.of(meets), share[meets]))
        to, going = torch.maximum(to, start), ~covered & ~over
        least, outside = (
            x.masked_fill(clear, fill) for x, fill in ((paths.least, torch.inf), (paths.outside, -torch.inf))
        )
        before, was = torch.where(gap, to, paths.t), value.masked_fill(gap, 1.0)
        paths = paths._replace(t=to, before=before, was=was, least=least, outside=outside).of(going)
    found = _Paths(*(torch.cat(columns) for columns in zip(*(each for each, _ in met), strict=True)))
    entered = found.outside > -torch.inf
    at = found.nearest
    at[entered], more = _refined(distance, rays, found.of(entered), EXACT * shortest)
    order = found.rays.argsort(stable=True)  # those of a ray are in order
    shares = torch.cat([share for _, share in met])
    return Crossings(found.rays[order], at[order], shares[order], evaluations + more)


def _noted(paths: _Paths, value: Tensor) -> _Paths:
    """Return the state after a look at the distance `value` at the rays' positions."""
    was_in = paths.outside > -torch.inf
    enters = ~was_in & (paths.was > 0) & (value <= 0)
    nearer = (value < paths.least) & (was_in | enters | (value > 0))  # not inside before the ray has left
    return paths._replace(
        least=torch.where(nearer, value, paths.least),
        nearest=torch.where(nearer, paths.t, paths.nearest),
        outside=torch.where(enters, paths.before, paths.outside),
        inside=torch.where(enters, paths.t, paths.inside),
        value_outside=torch.where(enters, paths.was, paths.value_outside),
        value_inside=torch.where(enters, value, paths.value_inside),
    )


def _refined(distance: DistanceFunction, rays: Rays, entered: _Paths, exact: float) -> tuple[Tensor, int]:
    """Return where distances are 0 (M,), and the number of evaluations.

    It is found by regula falsi (Illinois) between positions outside and inside.

    Args:
        distance, rays: as in `crossings`.
        entered: rays with such positions.
        exact: distance from the surface that suffices.
    """
    owners, (low, high, outside, inside) = entered.rays, entered[6:]
    at, left, evaluations = high.clone(), torch.arange(len(owners), device=owners.device), 0
    side = torch.zeros_like(owners)
    for _ in range(REFINEMENTS):
        here = low + (high - low) * (outside / (outside - inside))
        value = distance(rays.points(owners, here))
        at[left], evaluations, is_outside = here, evaluations + len(here), value > 0
        before, side = side, torch.where(is_outside, 1, -1)
        half = torch.where(side == before, 0.5, 1.0).to(value)  # an end that stays twice, so that it approaches too
        outside, inside = torch.where(is_outside, value, outside * half), torch.where(is_outside, inside * half, value)
        low, high = torch.where(is_outside, here, low), torch.where(is_outside, high, here)
        some = (value.abs() > exact).nonzero().squeeze(-1)
        left, owners, side = left[some], owners[some], side[some]
        low, high, outside, inside = (column[some] for column in (low, high, outside, inside))
    return at, evaluations


class FirstCrossing(WrappingSampler):
    """Samples of `sampler`, or with `traces` in evaluation those where a ray meets a surface, to the covering one."""

    sampler: OccupancySampler

    def __init__(self, sampler: OccupancySampler, traces: bool) -> None:
        super().__init__(sampler)
        self.traces = traces
        self.evaluations = 0
        """Number of evaluations for the last traced rays."""

    def sample(self, rays: Rays, field: Field, jitter: bool) -> Samples:
        if self.training or not self.traces:
            return self.sampler.sample(rays, field, jitter)
        assert isinstance(field, SurfaceField)
        with torch.no_grad():
            shortest = SHORTEST * self.sampler.step_size
            met = crossings(field.reach(SAFETY), rays, self.pieces(rays), shortest)
            self.evaluations = met.evaluations + len(met.t)
            counts = torch.bincount(met.owners, minlength=len(rays))
            offsets = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
            _, features = field.density(Points(rays.points(met.owners, met.t)))
        return Samples(met.t, met.t, offsets, owners=met.owners).with_alpha(met.coverage, features)

    def pieces(self, rays: Rays) -> Pieces:
        """Return the steps of `rays` in occupied cells."""
        marched = self.sampler.begin(rays, False, 0.0)
        while (wave := marched.wave(marched.next_limit)) is not None:
            marched.advance(torch.zeros_like(wave.t_starts))
        order, offsets = marched.finish()
        if not (waves := marched.waves):
            return Pieces(rays.nears[:0], rays.nears[:0], order, offsets)
        columns = [[w.t_starts for w in waves], [w.t_ends for w in waves], [w.owners for w in waves]]
        starts, ends, owners = gather_rows(columns, order)
        return Pieces(starts, ends, owners, offsets)
