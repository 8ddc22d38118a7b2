"""Marching through an occupancy grid, in Triton. `nerfloom.kernels.march.waves` has the definition.

Each thread processes a ray. It skips empty blocks of cells by their distance to an occupied block, up to the faces of
the smallest nested box that contains the position. Rays that have ended keep their places, so that the host waits once
per wave: for the number of samples, which it must know.
"""

# Triton gives the kernels' arguments their types.
# mypy: allow-untyped-defs, allow-untyped-decorators, allow-incomplete-defs

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.nn import functional

from nerfloom.geometry.rays import Rays
from nerfloom.kernels.march.occupancy import BLOCK as CELLS
from nerfloom.kernels.march.occupancy import Occupancy
from nerfloom.kernels.march.waves import March, Wave
from nerfloom.kernels.triton_launch import blocks, launch, optical_depth, own_rows

RAYS, SAMPLES = 32, 256
"""Rays, and samples, per program."""
MAX_BLOCK_DISTANCE = 16
"""Largest distance that is distinguished, in blocks."""
EDGE = tl.constexpr(CELLS)
INFINITY = tl.constexpr(math.inf)


def block_distances(occupied: Tensor, resolution: int) -> Tensor:
    """Return the distance in blocks, at most MAX_BLOCK_DISTANCE, from each block of cells to one with an occupied cell.

    Args:
        occupied: (n^3,) bool, as in `Occupancy`.
        resolution: number n of cells along each axis.

    Returns:
        (ceil(n / 4)^3,) uint8, the largest of the distances along the axes.
    """
    short = -resolution % CELLS
    grid = functional.pad(occupied.view(1, 1, *[resolution] * 3).float(), (0, short) * 3)
    near = functional.max_pool3d(grid, CELLS)
    distances = 1 - near
    for _ in range(MAX_BLOCK_DISTANCE - 1):
        near = functional.max_pool3d(near, 3, stride=1, padding=1)
        distances += 1 - near
    return distances.to(torch.uint8).flatten()


@triton.jit
def _slab(origins, directions, box, r, here, axis: tl.constexpr, enter, leave):
    """Return the distances where rays enter and leave the box, updated for one more axis."""
    o = tl.load(origins + r * 3 + axis, mask=here, other=0.0)
    d = tl.load(directions + r * 3 + axis, mask=here, other=1.0)
    low, high = tl.load(box + axis), tl.load(box + 3 + axis)
    over = 1 / tl.where(d == 0, 1.0, d)
    one, two = (low - o) * over, (high - o) * over
    outside = (o < low) | (o > high)  # for a ray parallel to the face
    enter = tl.where(d == 0, enter, tl.maximum(enter, tl.minimum(one, two)))
    leave = tl.where(d == 0, tl.where(outside, -1.0, leave), tl.minimum(leave, tl.maximum(one, two)))
    return enter, leave


@triton.jit(do_not_specialize=["rays"])
def _begin(
    origins, directions, nears, fars, shift, box, step, enters, leaves, firsts, alive, rays, BLOCK: tl.constexpr
):
    r, here = own_rows(rays, BLOCK)
    enter, leave = tl.load(nears + r, mask=here, other=0.0), tl.load(fars + r, mask=here, other=0.0)
    enter = tl.where(enter < 0, 0.0, enter)
    enter, leave = _slab(origins, directions, box, r, here, 0, enter, leave)
    enter, leave = _slab(origins, directions, box, r, here, 1, enter, leave)
    enter, leave = _slab(origins, directions, box, r, here, 2, enter, leave)
    first = enter
    if shift is not None:
        first = enter - tl.load(shift + r, mask=here, other=0.0) * step
    tl.store(enters + r, enter, mask=here)
    tl.store(leaves + r, leave, mask=here)
    tl.store(firsts + r, first, mask=here)
    tl.store(alive + r, (leave > enter).to(tl.uint8), mask=here)


@triton.jit
def _start(first, k, step, even, growth):
    """Return the start of steps k: evenly spaced up to step `even`, then growing by a factor of 2^growth each."""
    n = k.to(tl.float32)
    grown = (first + even * step) * tl.exp2((n - even) * growth)
    return tl.where(n <= even, first + n * step, grown)


@triton.jit
def _cell(position, last):
    """Return the cell of a position in units of cells, or the nearest one; NaN is in cell 0."""
    place = tl.where(position > 0, position, 0.0)
    return tl.where(place < last, place, last * 1.0).to(tl.int32)


@triton.jit
def _level(x, y, z, half, levels):
    """Return the index of the smallest nested box that contains a position, in cells of the smallest box."""
    far = tl.maximum(tl.maximum(tl.abs(x - half), tl.abs(y - half)), tl.abs(z - half)) / half
    level = (far.to(tl.int32, bitcast=True) >> 23) - 126  # far < 2^level, and not less than half of it
    return tl.minimum(tl.maximum(level, 0), levels - 1)


@triton.jit
def _shrunk(position, size, half):
    """Return a position in cells of a larger box with cells of this size; unchanged if it is 1."""
    return tl.where(size == 1, position, (position - half) * size + half)


@triton.jit
def _leave(position, direction, cell, size, more, resolution):
    """Return the distance where rays leave a cell's cube of `size` cells plus `more`, or the box, by an axis."""
    corner = cell - cell % size
    face = tl.where(direction > 0, tl.minimum(corner + size + more, resolution), tl.maximum(corner - more, 0))
    distance = (face.to(tl.float32) - position) / tl.where(direction == 0, 1.0, direction)
    return tl.where(direction == 0, INFINITY, distance)


@triton.jit(do_not_specialize=["rays", "levels"])
def _wave(
    origins, directions, box, enters, leaves, firsts, slices, alive, nexts, occupied, distances, counts, places, limits,
    starts, ends, rays, limit, resolution, levels, step, growth, turn, BLOCK: tl.constexpr,
):  # fmt: skip
    r, here = own_rows(rays, BLOCK)
    enter, leave = tl.load(enters + r, mask=here, other=0.0), tl.load(leaves + r, mask=here, other=0.0)
    first = tl.load(firsts + r, mask=here, other=0.0)
    # Where steps begin to grow: at `turn`, or at the ray's start.
    even = tl.where(growth > 0, tl.ceil(tl.maximum(turn - first, 0.0) / step), INFINITY)
    base = tl.where(growth > 0, first + even * step, 1.0)
    scale_x = resolution / (tl.load(box + 3) - tl.load(box))
    scale_y = resolution / (tl.load(box + 4) - tl.load(box + 1))
    scale_z = resolution / (tl.load(box + 5) - tl.load(box + 2))
    x = (tl.load(origins + r * 3, mask=here, other=0.0) - tl.load(box)) * scale_x
    y = (tl.load(origins + r * 3 + 1, mask=here, other=0.0) - tl.load(box + 1)) * scale_y
    z = (tl.load(origins + r * 3 + 2, mask=here, other=0.0) - tl.load(box + 2)) * scale_z
    dx = tl.load(directions + r * 3, mask=here, other=0.0) * scale_x
    dy = tl.load(directions + r * 3 + 1, mask=here, other=0.0) * scale_y
    dz = tl.load(directions + r * 3 + 2, mask=here, other=0.0) * scale_z
    k, found = tl.load(nexts + r, mask=here, other=0), tl.zeros([BLOCK], tl.int32)
    place, most = r * limit, found + limit  # position of a ray's samples, and their maximum number
    if places is not None:
        place = tl.load(places + r, mask=here, other=0)
        most = tl.load(limits + r, mask=here, other=0).to(tl.int32)
    side, half = (resolution + EDGE - 1) // EDGE, resolution / 2
    before = tl.zeros([BLOCK], tl.int64)  # number of time slices before the ray's, for a grid of one box
    if slices is not None:
        before = tl.load(slices + r, mask=here, other=0)
    going = here & (tl.load(alive + r, mask=here, other=0) != 0) & (most > 0)
    while tl.max(going.to(tl.int32), 0) > 0:
        start, end = _start(first, k, step, even, growth), _start(first, k + 1, step, even, growth)
        middle = (start + end) / 2
        going = going & (middle < leave)
        level = _level(x + middle * dx, y + middle * dy, z + middle * dz, half, levels)
        size = ((127 - level) << 23).to(tl.float32, bitcast=True)
        px, py, pz = _shrunk(x, size, half), _shrunk(y, size, half), _shrunk(z, size, half)
        i, j = _cell(px + middle * dx * size, resolution - 1), _cell(py + middle * dy * size, resolution - 1)
        m = _cell(pz + middle * dz * size, resolution - 1)
        box_of = before + level
        block = ((box_of * side + i // EDGE) * side + j // EDGE) * side + m // EDGE
        distance = tl.load(distances + block, mask=going, other=0).to(tl.int32)
        cell = ((box_of * resolution + i) * resolution + j) * resolution + m
        full = going & (distance == 0) & (tl.load(occupied + cell, mask=going, other=0) != 0)
        taken = full & (middle >= enter)
        if starts is not None:  # otherwise they are only counted
            tl.store(starts + place + found, start, mask=taken)
            tl.store(ends + place + found, end, mask=taken)
        found += taken.to(tl.int32)
        cube, more = tl.where(distance == 0, 1, EDGE), tl.maximum(distance - 1, 0) * EDGE
        clear = _leave(px, dx * size, i, cube, more, resolution)
        clear = tl.minimum(clear, _leave(py, dy * size, j, cube, more, resolution))
        clear = tl.minimum(clear, _leave(pz, dz * size, m, cube, more, resolution))
        # The last step that certainly ends before that.
        steps = (clear - first) / step
        if growth > 0:
            steps = tl.where(steps > even, even + tl.log2(tl.maximum(clear / base, 1e-30)) / growth, steps)
        skipped = tl.minimum(steps, 2e9).to(tl.int32) - 1
        k = tl.where(going, tl.where(full, k + 1, tl.maximum(k + 1, skipped)), k)
        going = going & (found < most)
    tl.store(nexts + r, k, mask=here)
    tl.store(counts + r, found, mask=here)


@triton.jit(do_not_specialize=["slots"])
def _pack(
    origins, directions, padded_starts, padded_ends, counts, offsets, starts, ends, owners, positions, slots, limit,
    BLOCK: tl.constexpr,
):  # fmt: skip
    i, here = own_rows(slots, BLOCK)
    r, s = i // limit, i % limit
    here = here & (s < tl.load(counts + r, mask=here, other=0))
    n = tl.load(offsets + r, mask=here, other=0) + s
    start, end = tl.load(padded_starts + i, mask=here, other=0.0), tl.load(padded_ends + i, mask=here, other=0.0)
    tl.store(starts + n, start, mask=here)
    tl.store(ends + n, end, mask=here)
    tl.store(owners + n, r, mask=here)
    for axis in tl.static_range(3):
        origin = tl.load(origins + r * 3 + axis, mask=here, other=0.0)
        direction = tl.load(directions + r * 3 + axis, mask=here, other=0.0)
        tl.store(positions + n * 3 + axis, origin + (start + end) / 2 * direction, mask=here)


@triton.jit(do_not_specialize=["rays"])
def _advance(sigma, starts, ends, offsets, counts, spent, alive, reached, budget, rays, limit, BLOCK: tl.constexpr):
    r, here = own_rows(rays, BLOCK)
    first, count = tl.load(offsets + r, mask=here, other=0), tl.load(counts + r, mask=here, other=0)
    depth = tl.load(spent + r, mask=here, other=0.0)
    for s in range(limit):
        present = s < count
        n = first + s
        tl.store(reached + n, tl.where(depth >= budget, 0, 1).to(tl.uint8), mask=present)  # NaN must be noticed
        length = tl.load(ends + n, mask=present, other=0.0) - tl.load(starts + n, mask=present, other=0.0)
        depth += optical_depth(tl.load(sigma + n, mask=present, other=0.0), length)
    tl.store(spent + r, depth, mask=here)
    going = (count == limit) & (tl.where(depth >= budget, 0, 1) != 0)
    tl.store(alive + r, going.to(tl.uint8), mask=here)


class TritonMarch(March):
    """The march in Triton, for float32.

    `rays`, `occupancy`, `step`, `cone`, `shift` and `early_stop` are as in `nerfloom.kernels.march.waves.march`.
    """

    def __init__(
        self, rays: Rays, occupancy: Occupancy, step: float, cone: float, shift: Tensor | None, early_stop: float
    ) -> None:
        super().__init__(rays, early_stop)
        self.occupied, self.distances = occupancy.occupied, occupancy.distances
        self.slices = occupancy.slices_of(rays.times)
        self.origins, self.directions = rays.origins.contiguous(), rays.directions.contiguous()
        self.box, self.resolution, self.step = occupancy.box.contiguous(), occupancy.resolution, float(step)
        self.levels, outer = occupancy.levels, occupancy.outer.contiguous()
        self.growth, self.turn = (math.log2(1 + cone), step / cone) if cone else (0.0, math.inf)
        nears, count = rays.nears.contiguous(), len(rays)
        self.enter, self.leave, self.first = (torch.empty_like(nears) for _ in range(3))
        self.alive = torch.empty(count, dtype=torch.uint8, device=nears.device)
        self.next = torch.zeros(count, dtype=torch.int32, device=nears.device)
        self.spent = torch.zeros_like(nears)
        launch(
            _begin, (blocks(count, SAMPLES),), self.origins, self.directions, nears, rays.fars.contiguous(),
            None if shift is None else shift.contiguous(), outer, self.step, self.enter, self.leave, self.first,
            self.alive, count, BLOCK=SAMPLES,
        )  # fmt: skip

    def wave(self, limit: int) -> Wave | None:
        rays, like = len(self.spent), self.spent
        counts = torch.empty_like(self.next)
        padded_starts, padded_ends = like.new_empty(rays, limit), like.new_empty(rays, limit)
        self.go_on(limit, counts, padded_starts, padded_ends)
        offsets = functional.pad(counts.cumsum(0), (1, 0))
        count = int(offsets[-1])
        if count == 0:
            return None
        starts, ends, positions = like.new_empty(count), like.new_empty(count), like.new_empty(count, 3)
        owners = torch.empty(count, dtype=torch.int64, device=like.device)
        launch(
            _pack, (blocks(rays * limit, SAMPLES),), self.origins, self.directions, padded_starts, padded_ends, counts,
            offsets, starts, ends, owners, positions, rays * limit, limit, BLOCK=SAMPLES,
        )  # fmt: skip
        self.counts, self.offsets, self.limit = counts, offsets, limit
        wave = Wave(starts, ends, owners, positions)
        self.waves.append(wave)
        return wave

    def go_on(
        self, limit: int, counts: Tensor, starts: Tensor | None = None, ends: Tensor | None = None,
        places: Tensor | None = None, limits: Tensor | None = None,
    ) -> None:  # fmt: skip
        """Continue the march of each active ray, and write its samples.

        Args:
            limit: maximum number of samples per ray.
            counts: (R,) int32, receives the number of samples of each ray.
            starts, ends: receive the starts and ends of samples; None to only count them.
            places: (R,) int64 positions for the samples of each ray; if None, each ray has `limit` positions.
            limits: (R,) int64 maximum number of samples of each ray, instead of `limit`; with `places`.
        """
        rays = len(self.spent)
        launch(
            _wave, (blocks(rays, RAYS),), self.origins, self.directions, self.box, self.enter, self.leave, self.first,
            self.slices, self.alive, self.next, self.occupied, self.distances, counts, places, limits, starts, ends,
            rays, limit, self.resolution, self.levels, self.step, self.growth, self.turn, BLOCK=RAYS, num_warps=1,
        )  # fmt: skip

    def advance(self, sigma: Tensor) -> None:
        wave, rays = self.waves[-1], len(self.spent)
        reached = torch.empty(len(wave.owners), dtype=torch.uint8, device=sigma.device)
        launch(
            _advance, (blocks(rays, SAMPLES),), sigma.detach().float().contiguous(), wave.t_starts, wave.t_ends,
            self.offsets, self.counts, self.spent, self.alive, reached, self.budget, rays, self.limit, BLOCK=SAMPLES,
        )  # fmt: skip
        self.reached.append(reached)


def sort_by_ray(owners: Tensor, reached: Tensor, num_rays: int) -> tuple[Tensor, Tensor]:
    """Compute `nerfloom.kernels.march.waves.sort_by_ray` of `owners`, `reached` and `num_rays`; the host waits once."""
    kept = reached != 0
    counts = torch.zeros(num_rays, dtype=torch.int64, device=owners.device).index_add_(0, owners, kept.long())
    offsets = functional.pad(counts.cumsum(0), (1, 0))
    order = torch.where(kept, owners, num_rays).sort(stable=True).indices
    return order[: int(offsets[-1])], offsets
