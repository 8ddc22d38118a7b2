"""Sphere tracing of a signed distance (Hart 1996): where rays meet surfaces, up to one that covers the ray.

A ray advances by the distance at its position, so it takes few steps far from a surface. It stays in occupied cells;
the space between them counts as outside, and is crossed at once by the grid's map of distances to occupied blocks. A
learnt distance is not exact. So steps are divided by a safety factor and by the slope at the position, if above 1
(`stepped` states when this passes no surface). If a ray has passed the surface, the crossing is found between its last
two positions.

A pixel is a cone. Let m be the minimum distance of a ray that passes a surface, and r the cone's radius there. If the
surface's edge is straight, it covers (r - m) / (2 r) of the cone. So edges are smooth with one ray per pixel.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from nerfloom.geometry.points import radii_at
from nerfloom.geometry.rays import Rays
from nerfloom.kernels import native
from nerfloom.kernels.dispatch import CPP, Operation
from nerfloom.kernels.march.waves import CompiledMarch, March
from nerfloom.kernels.rows import gather_rows
from nerfloom.kernels.surfaces.signed_distance import DISTANCE, SignedDistance, distance_arguments, is_compiled

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
    # The first piece may begin at the face of the box, with the outside behind it, or at the ray's own start.
    was = torch.where(first > rays.nears[active] + shortest, 1.0, -1.0).to(first)
    unclear = torch.full_like(first, -torch.inf)
    paths = _Paths(active, first, first, was, was * torch.inf, first, unclear, first, first, first)
    span = 2 * (float(pieces.ends.max()) + shortest) if len(active) else 1.0  # one number orders ray and distance
    ends = pieces.owners.double() * span + pieces.ends
    met, evaluations = [(paths.of(active < 0), first[:0])], 0
    while len(paths.rays):
        value = distance(rays.points(paths.rays, paths.t))
        evaluations += len(value)
        radius = radii_at(paths.t, radii[paths.rays], rays.parallel)
        paths = _noted(paths, value)
        covered = (paths.outside > -torch.inf) & (paths.least <= -radius) | value.isnan()  # a broken field shows
        # The length is at least a few units in the last place, so that a ray far away ends too.
        step = value.abs().clamp(min=shortest).maximum(radius / 2).maximum(4 * torch.finfo(value.dtype).eps * paths.t)
        to = paths.t + step
        piece = torch.searchsorted(ends, paths.rays.double() * span + to, right=True)
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
    order = found.rays.argsort(stable=True)  # the crossings of a ray are in order
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


def pieces_of(marched: March) -> Pieces:
    """Return the steps of a march in occupied cells.

    Args:
        marched: the march, before its first wave, without an early stop.
    """
    while (wave := marched.wave(marched.next_limit)) is not None:
        marched.advance(torch.zeros_like(wave.t_starts))
    order, offsets = marched.finish()
    if not (waves := marched.waves):
        nothing = marched.rays.nears[:0]
        return Pieces(nothing, nothing, order, offsets)
    columns = [[w.t_starts for w in waves], [w.t_ends for w in waves], [w.owners for w in waves]]
    starts, ends, owners = gather_rows(columns, order)
    return Pieces(starts, ends, owners, offsets)


@torch.no_grad()
def marched_crossings(marched: March, known: SignedDistance, shortest: float, safety: float) -> Crossings:
    """Return where rays meet surfaces in occupied cells, up to the first that covers them, as `crossings` does.

    Args:
        marched: the march of R rays, before its first wave, without an early stop and with steps of one length.
        known: the distance.
        shortest: minimum advance, scene units.
        safety: factor of steps (`stepped`).
    """
    tensors = marched.rays.origins, known.table, known.first, known.second
    return MARCHED_CROSSINGS(tensors, marched, known, shortest, safety)


def marched_crossings_reference(marched: March, known: SignedDistance, shortest: float, safety: float) -> Crossings:
    """Compute `marched_crossings` of `marched`, `known`, `shortest` and `safety` by `crossings`, on any device."""
    return crossings(partial(known.reach, safety=safety), marched.rays, pieces_of(marched), shortest)


MARCHED_CROSSINGS = Operation("marched_crossings", marched_crossings_reference)
_find: Callable[..., int] = native.Function("crossings_find", "pppppppqpfppifffi" + DISTANCE + "i", "q")
_take: Callable[..., int] = native.Function("crossings_take", "qqppp", "q")


def _fits(marched: March, known: SignedDistance, shortest: float, safety: float) -> bool:
    if not isinstance(marched, CompiledMarch) or marched.waves or not is_compiled(known):
        return False
    return marched.levels == 1 and marched.cone == 0 and marched.slices is None and not marched.rays.parallel


@MARCHED_CROSSINGS.implementation(CPP, order=0, differentiable=0, fits=_fits)
def _compiled(marched: March, known: SignedDistance, shortest: float, safety: float) -> Crossings:
    assert isinstance(marched, CompiledMarch)
    rays, count = marched.rays, len(marched.rays)
    nears, radii = rays.nears.contiguous(), None if rays.pixel_radii is None else rays.pixel_radii.contiguous()
    total = _find(
        marched.origins.data_ptr(), marched.directions.data_ptr(), marched.enter.data_ptr(), marched.leave.data_ptr(),
        marched.first.data_ptr(), native.pointer(nears, "nears", (count,)),
        None if radii is None else native.pointer(radii, "the cones' radii", (count,)), count, marched.box.data_ptr(),
        marched.step, marched.bits.data_ptr(), marched.blocks.data_ptr(), marched.resolution, shortest, safety,
        EXACT * shortest, REFINEMENTS, *distance_arguments(known), native.threads(),
    )  # fmt: skip
    owners, t, coverage = torch.empty(total, dtype=torch.int64), torch.empty(total), torch.empty(total)
    evaluations = _take(count, total, owners.data_ptr(), t.data_ptr(), coverage.data_ptr())
    return Crossings(owners, t, coverage, evaluations)
