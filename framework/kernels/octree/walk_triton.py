"""Walks of rays through the levels of an octree, in Triton: functions for kernels. `walk.py` has the definition.

Each thread walks along a ray, as a lane does in `walk.h`.
"""

# Triton gives the kernels' arguments their types.
# mypy: allow-untyped-defs, allow-untyped-decorators, allow-incomplete-defs

from __future__ import annotations

import math

import triton
import triton.language as tl

from nerfloom.kernels.octree import layout, walk

BRICK, OCTANT = tl.constexpr(layout.BRICK), tl.constexpr(layout.OCTANT)
FRAME, NUMBERS = tl.constexpr(4), tl.constexpr(6)
"""Columns of `Tables.frames` and `Tables.numbers`."""
FARTHEST, SMALLEST = tl.constexpr(walk.FARTHEST), tl.constexpr(walk.SMALLEST)
INFINITY = tl.constexpr(math.inf)


@triton.jit
def _in_cells(origins, directions, frames, r, here, level, axis: tl.constexpr):
    """Return origins and directions of rays along an axis, in cells of a level of each."""
    cell = tl.load(frames + level * FRAME + 3)
    p = (tl.load(origins + r * 3 + axis, mask=here, other=0.0) - tl.load(frames + level * FRAME + axis)) / cell
    d = tl.load(directions + r * 3 + axis, mask=here, other=1.0) / cell
    tiny = tl.where(d.to(tl.int32, bitcast=True) < 0, -SMALLEST, SMALLEST)
    return p, tl.where(tl.abs(d) < SMALLEST, tiny, d)


@triton.jit
def _clip(
    origins, directions, nears, fars, smallest, frames, numbers, r, here, level, last, LIMITED: tl.constexpr
):  # fmt: skip
    """Return where a level of each ray may show it: in the level's box, and while its cells are not too small."""
    begin, end = tl.load(nears + r, mask=here, other=0.0), tl.load(fars + r, mask=here, other=0.0)
    begin, good = tl.where(begin > 0, begin, 0.0), here
    for axis in tl.static_range(3):
        p, d = _in_cells(origins, directions, frames, r, here, level, axis)
        size, over = tl.load(numbers + level * NUMBERS + axis).to(tl.float32) * BRICK, 1 / d
        one, two = (0 - p) * over, (size - p) * over
        begin = tl.maximum(begin, tl.minimum(one, two))
        end = tl.minimum(end, tl.maximum(one, two))
        good = good & (tl.abs(p) < FARTHEST) & (tl.abs(d) < 1e9)  # not NaN
    if LIMITED:
        least = tl.load(smallest + r, mask=here, other=0.0)
        reach = tl.load(frames + level * FRAME + 3) / tl.where(least > 0, least, 1.0)
        end = tl.where((level < last) & (least > 0), tl.minimum(end, reach), end)
    return begin, tl.where(good, end, -1.0)


@triton.jit
def _enter(
    origins, directions, nears, fars, smallest, frames, numbers, r, here, now, levels, LIMITED: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Return the finest level that shows each ray at a distance, -1 for none; where it ends; where another begins."""
    level = tl.full([BLOCK], -1, tl.int32)
    far, closest = tl.zeros([BLOCK], tl.float32), tl.full([BLOCK], INFINITY, tl.float32)
    for number in range(levels):
        each = tl.zeros([BLOCK], tl.int32) + number
        begin, end = _clip(
            origins, directions, nears, fars, smallest, frames, numbers, r, here, each, levels - 1, LIMITED
        )
        some = (begin < end) & (now < end)
        inside = some & (begin <= now) & (level < 0)
        far = tl.where(inside, tl.minimum(end, closest), far)
        level = tl.where(inside, each, level)
        closest = tl.where(some & (begin > now), tl.minimum(closest, begin), closest)
    return level, far, closest


@triton.jit
def _stand(origins, directions, frames, numbers, r, here, level, now, axis: tl.constexpr):
    """Return origins and directions of rays along an axis, in cells of their level, and their cells at a distance."""
    known = tl.maximum(level, 0)
    p, d = _in_cells(origins, directions, frames, r, here, known, axis)
    p, d = tl.where(level < 0, 0.0, p), tl.where(level < 0, 1.0, d)
    at = p + now * d
    cell = tl.where(at > 0, tl.minimum(at, 1e9), 0.0).to(tl.int32)
    return p, d, tl.minimum(cell, tl.load(numbers + known * NUMBERS + axis).to(tl.int32) * BRICK - 1)


@triton.jit
def _begin(
    origins, directions, nears, fars, smallest, frames, numbers, r, here, levels, LIMITED: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Return the level, -1 for none, where rays begin, where it ends, and the distance where they begin."""
    t = tl.full([BLOCK], -1.0, tl.float32)
    _, _, first = _enter(
        origins, directions, nears, fars, smallest, frames, numbers, r, here, t, levels, LIMITED, BLOCK
    )
    some = here & (first < INFINITY)
    t = tl.where(some, first, 0.0)
    level, far, _ = _enter(
        origins, directions, nears, fars, smallest, frames, numbers, r, some, t, levels, LIMITED, BLOCK
    )
    return level, far, t


@triton.jit
def _place(origins, directions, frames, numbers, r, here, level, now):
    """Return origin, direction and cell at a distance, in the level's cells, along each axis."""
    px, dx, x = _stand(origins, directions, frames, numbers, r, here, level, now, 0)
    py, dy, y = _stand(origins, directions, frames, numbers, r, here, level, now, 1)
    pz, dz, z = _stand(origins, directions, frames, numbers, r, here, level, now, 2)
    return px, dx, x, py, dy, y, pz, dz, z


@triton.jit
def _change(
    origins, directions, nears, fars, smallest, frames, numbers, r, here, leaving, level, far, t, x, y, z, levels,
    LIMITED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Return levels, their ends, and `_place`, of rays after all rays that are `leaving` have entered another level."""
    other, end, _ = _enter(
        origins, directions, nears, fars, smallest, frames, numbers, r, leaving, t, levels, LIMITED, BLOCK
    )
    level, far = tl.where(leaving, other, level), tl.where(leaving, end, far)
    px, dx, i, py, dy, j, pz, dz, k = _place(origins, directions, frames, numbers, r, here, level, t)
    x, y, z = tl.where(leaving, i, x), tl.where(leaving, j, y), tl.where(leaving, k, z)
    return level, far, px, dx, x, py, dy, y, pz, dz, z


@triton.jit
def _ones(word):
    """Return the number of bits of 64-bit words that are 1."""
    pairs = word - ((word >> 1) & 0x5555555555555555)
    fours = (pairs & 0x3333333333333333) + ((pairs >> 2) & 0x3333333333333333)
    return (((fours + (fours >> 4)) & 0x0F0F0F0F0F0F0F0F) * 0x0101010101010101) >> 56


@triton.jit
def _look(numbers, bricks, masks, firsts, level, x, y, z, going):
    """Return the block around cells: its edge and low corner, and its leaf; -1 if it is empty."""
    of = numbers + level * NUMBERS
    i, j, k = x // BRICK, y // BRICK, z // BRICK
    index = (i * tl.load(of + 1) + j) * tl.load(of + 2) + k
    brick = tl.load(bricks + tl.load(of + 3) + index, mask=going, other=-1)
    void = brick < 0
    octant = x // OCTANT % 2 + y // OCTANT % 2 * 2 + z // OCTANT % 2 * 4
    slot = (tl.load(of + 4) + tl.where(void, 0, brick)) * 8 + octant
    mask = tl.load(masks + slot, mask=going & (brick >= 0), other=0)
    bit = (x % OCTANT + y % OCTANT * 4 + z % OCTANT * 16).to(tl.int64)
    leaf = tl.load(firsts + slot, mask=going & (mask != 0), other=0) + tl.load(of + 5)
    leaf += _ones(mask & ((1 << bit) - 1))
    leaf = tl.where(((mask >> bit) & 1) != 0, leaf, -1)
    size = tl.where(void, (-2 * brick - 1) * BRICK, tl.where(mask == 0, OCTANT, 1))
    low_x = tl.where(void, (i + brick + 1) * BRICK, tl.where(mask == 0, x - x % OCTANT, x))
    low_y = tl.where(void, (j + brick + 1) * BRICK, tl.where(mask == 0, y - y % OCTANT, y))
    low_z = tl.where(void, (k + brick + 1) * BRICK, tl.where(mask == 0, z - z % OCTANT, z))
    return size, low_x, low_y, low_z, leaf


@triton.jit
def _side(low, size, p, d):
    """Return the side along an axis where rays may leave a block, and the distance there."""
    side = low + tl.where(d > 0, size, 0)
    return side, (side.to(tl.float32) - p) / d


@triton.jit
def _moved(low, size, side, leave, p, d, reach):
    """Return the next cell along an axis: behind the side that a ray leaves by, else the cell of its position."""
    cell = tl.minimum(tl.maximum(p + reach * d, 0.0), 1e9).to(tl.int32)
    cell = tl.minimum(tl.maximum(cell, low), low + size - 1)
    return tl.where(leave <= reach, tl.where(d > 0, side, side - 1), cell)


@triton.jit
def _advance(size, low_x, low_y, low_z, px, dx, py, dy, pz, dz, t, far):
    """Return the distances where rays leave blocks, or their ranges, and the next cells."""
    side_x, leave_x = _side(low_x, size, px, dx)
    side_y, leave_y = _side(low_y, size, py, dy)
    side_z, leave_z = _side(low_z, size, pz, dz)
    reach = tl.minimum(tl.minimum(far, leave_x), tl.minimum(leave_y, leave_z))
    reach = tl.maximum(reach, t)  # rounding must not lead back
    x = _moved(low_x, size, side_x, leave_x, px, dx, reach)
    y = _moved(low_y, size, side_y, leave_y, py, dy, reach)
    z = _moved(low_z, size, side_z, leave_z, pz, dz, reach)
    return reach, x, y, z


@triton.jit
def _outside(numbers, level, x, y, z):
    """Return whether cells are outside of the level's box."""
    of = numbers + level * NUMBERS
    below = (x < 0) | (y < 0) | (z < 0)
    return below | (x >= tl.load(of) * BRICK) | (y >= tl.load(of + 1) * BRICK) | (z >= tl.load(of + 2) * BRICK)
