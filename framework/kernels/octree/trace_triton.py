"""Light along rays through an octree, in Triton. `walk.py` and `light.py` have the definition.

The backward pass walks again: the light behind a leaf is the whole light minus the leaf and everything in front of it.
The gradient of the leaves is accumulated by atomic operations, so its rounding errors depend on the order of
execution.
"""

# Triton gives the kernels' arguments their types.
# mypy: allow-untyped-defs, allow-untyped-decorators, allow-incomplete-defs

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerfloom.geometry.rays import Rays
from nerfloom.kernels.adam.row_gradient import RowGradient
from nerfloom.kernels.encodings.harmonics_triton import harmonics
from nerfloom.kernels.octree import packed
from nerfloom.kernels.octree.layout import OctreeLayout
from nerfloom.kernels.octree.light import OctreeLight, contiguous, outputs_of
from nerfloom.kernels.octree.packed import PackedLeaves
from nerfloom.kernels.octree.walk import smallest_cells
from nerfloom.kernels.octree.walk_triton import FRAME, _advance, _begin, _change, _look, _outside, _place
from nerfloom.kernels.triton_launch import blocks, launch, load_three, opacity_of, own_rows

RAYS = 32
"""Rays per program."""
CODES = tl.constexpr(packed.CODES)


@triton.jit
def _basis(directions, r, here, BASIS: tl.constexpr, N: tl.constexpr, BLOCK: tl.constexpr):
    """Return the harmonics (BLOCK, N) of rays' directions, once for each channel."""
    x, y, z = load_three(directions + r * 3, here)
    k, out = tl.arange(0, N) % BASIS, tl.full([BLOCK, N], 0.28209479177387814, tl.float32)
    for number in tl.static_range(1, BASIS):
        out = tl.where((k == number)[None, :], harmonics(x, y, z, number)[:, None], out)
    return out


@triton.jit
def _light(values, table, level, leaf, met, length, through):
    """Return the optical depths of leaves' edges, of rays in them, and the rays' weights there."""
    if table is not None:
        code = tl.load(values + leaf, mask=met, other=0).to(tl.int32)
        edge = tl.load(table + level * CODES + code, mask=met, other=0.0)
    else:
        raw = tl.load(values + leaf, mask=met, other=-1e9)
        edge = tl.where(raw > 1, raw, tl.exp(tl.where(raw > 1, 1.0, raw) - 1))
    tau = edge * length
    return edge, tau, tl.where(met, through * opacity_of(tau), 0.0)


@triton.jit
def _known(
    directions, color, opacity, of_color, of_opacity, r, here, BASIS: tl.constexpr, N: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    """Return derivatives of the loss: by opacity, by the light of whole rays, by coefficients of a leaf of weight 1."""
    opaque = tl.zeros([BLOCK], tl.float32)
    if of_opacity is not None:
        opaque = tl.load(of_opacity + r, mask=here, other=0.0)
    whole = opaque * tl.load(opacity + r, mask=here, other=0.0)
    mixed, channel = _basis(directions, r, here, BASIS, N, BLOCK), tl.arange(0, N) // BASIS
    slopes = tl.zeros([BLOCK, N], tl.float32)
    for c in tl.static_range(3):
        slope = tl.load(of_color + r * 3 + c, mask=here, other=0.0)
        whole += slope * tl.load(color + r * 3 + c, mask=here, other=0.0)
        slopes = tl.where((channel == c)[None, :], slope[:, None], slopes)
    return opaque, whole, mixed * slopes


@triton.jit
def _finish(
    directions, fars, scales, offsets, background, color, moment, median, visits, r, here, through, sums, mean, half,
    count, BASIS: tl.constexpr, N: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the light of rays from their sums."""
    columns = tl.arange(0, N)
    if scales is not None:
        scale = tl.load(scales + columns, mask=columns < 3 * BASIS, other=0.0)
        offset = tl.load(offsets + columns, mask=columns < 3 * BASIS, other=0.0)
        sums = sums * scale[None, :] + (1 - through)[:, None] * offset[None, :]
    sums = sums * _basis(directions, r, here, BASIS, N, BLOCK)
    for c in tl.static_range(3):
        total = tl.sum(tl.where((columns // BASIS == c)[None, :], sums, 0.0), 1)
        total += through * tl.load(background + r * 3 + c, mask=here, other=0.0)
        tl.store(color + r * 3 + c, total, mask=here)
    end = tl.load(fars + r, mask=here, other=0.0)
    tl.store(moment + r, mean, mask=here)
    tl.store(median + r, tl.where(half < 0, end, tl.minimum(half, end)), mask=here)
    tl.store(visits + r, count, mask=here)


@triton.jit(do_not_specialize=["levels", "rays"])
def _walk(
    origins, directions, nears, fars, smallest, frames, numbers, bricks, masks, firsts, values, table, colors, scales,
    offsets, background, color, opacity, moment, median, visits, peaks, of_color, of_opacity, of_values, of_colors,
    levels, limit, rays, BASIS: tl.constexpr, N: tl.constexpr, LIMITED: tl.constexpr, MANY: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    r, here = own_rows(rays, BLOCK)
    columns = tl.arange(0, N)
    if of_color is not None:  # the backward pass
        opaque, behind, mixed = _known(directions, color, opacity, of_color, of_opacity, r, here, BASIS, N, BLOCK)
    level, far, t = _begin(origins, directions, nears, fars, smallest, frames, numbers, r, here, levels, LIMITED, BLOCK)
    px, dx, x, py, dy, y, pz, dz, z = _place(origins, directions, frames, numbers, r, here, level, t)
    through, half = tl.full([BLOCK], 1.0, tl.float32), tl.full([BLOCK], -1.0, tl.float32)
    mean, count, sums = tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.int32), tl.zeros([BLOCK, N], tl.float32)
    going = level >= 0
    while tl.max(going.to(tl.int32), 0) > 0:
        known = tl.maximum(level, 0)
        size, low_x, low_y, low_z, leaf = _look(numbers, bricks, masks, firsts, known, x, y, z, going)
        reach, x, y, z = _advance(size, low_x, low_y, low_z, px, dx, py, dy, pz, dz, t, far)
        met, length = going & (leaf >= 0), (reach - t) / tl.load(frames + known * FRAME + 3)
        edge, tau, weight = _light(values, table, known, leaf, met, length, through)
        after = through - weight
        if colors is not None:
            row = leaf[:, None] * (3 * BASIS) + columns[None, :]
            some = met[:, None] & (columns < 3 * BASIS)[None, :]
            coefficients = tl.load(colors + row, mask=some, other=0).to(tl.float32)
            if of_color is not None:
                shown = opaque + tl.sum(mixed * coefficients, 1)
                behind = tl.where(met, behind - weight * shown, behind)
                # The slope of the depth by raw is the depth itself, up to 1.
                of_raw = (after * shown - behind) * length * tl.where(edge > 1, 1.0, edge)
                tl.atomic_add(of_values + leaf, of_raw, mask=met, sem="relaxed")
                tl.atomic_add(of_colors + row, weight[:, None] * mixed, mask=some, sem="relaxed")
            else:
                sums += weight[:, None] * coefficients
                mean, count = mean + weight * 0.5 * (t + reach), count + met.to(tl.int32)
                crosses = met & (half < 0) & (after <= 0.5)
                share = tl.log(tl.where(crosses, 2 * through, 1.0)) / tl.where(crosses, tau, 1.0)
                half = tl.where(crosses, t + (reach - t) * share, half)
        if peaks is not None:  # the bits of numbers of at least 0 are in their order
            tl.atomic_max(peaks + leaf, weight.to(tl.int32, bitcast=True), mask=met, sem="relaxed")
        t = tl.where(going, tl.where(_outside(numbers, known, x, y, z), far, reach), t)
        through, going = after, going & (tl.where(after < limit, 0, 1) != 0)  # NaN goes on
        leaving = going & (t >= far)
        if MANY:
            if tl.max(leaving.to(tl.int32), 0) > 0:
                level, far, px, dx, x, py, dy, y, pz, dz, z = _change(
                    origins, directions, nears, fars, smallest, frames, numbers, r, here, leaving, level, far, t, x, y,
                    z, levels, LIMITED, BLOCK,
                )  # fmt: skip
                going = going & (level >= 0)
        else:
            going = going & (t < far)
    if of_color is None:
        tl.store(opacity + r, 1 - through, mask=here)
        if colors is not None:
            _finish(
                directions, fars, scales, offsets, background, color, moment, median, visits, r, here, through, sums,
                mean, half, count, BASIS, N, BLOCK,
            )  # fmt: skip


def _run(
    layout: OctreeLayout, rays: Rays, stop: float, smallest: Tensor | None, values: Tensor, table: Tensor | None,
    colors: Tensor | None, affine: tuple[Tensor | None, Tensor | None], background: Tensor | None,
    out: tuple[Tensor | None, ...], peaks: Tensor | None, gradients: tuple[Tensor | None, ...] = (None,) * 4,
) -> None:  # fmt: skip
    """Walk along rays.

    Args:
        layout: where the L leaves are.
        rays: R contiguous rays.
        stop: transmittance below which a ray ends.
        smallest: (R,) smallest edge of cells, per unit of distance; None to choose levels by boxes alone.
        values: raw densities, or codes of depths if there is a `table`.
        table: optical depths by level and code; None for raw densities.
        colors: (L, 3 K) coefficients of the leaves; None for no colours.
        affine: scale and offset (3 K,) of coefficients in bytes; None twice otherwise.
        background: (R, 3) colour of the background; None without colours.
        out: colour, opacity, moment, median and visits, which are written; in the backward pass colour and opacity are
            read, and the others None.
        peaks: (L,) largest weights, which are raised; None for none.
        gradients: of the colour, of the opacity or None, and of `values` and `colors`, which are added to; all None in
            the forward pass.
    """
    tables, count, width = layout.tables, len(rays), 3 if colors is None else colors.shape[1]
    limited = smallest is not None and layout.coarser is not None
    launch(
        _walk, (blocks(count, RAYS),), rays.origins, rays.directions, rays.nears, rays.fars,
        smallest if limited else rays.fars, *tables, values, table, colors, *affine, background, *out,
        None if peaks is None else peaks.view(torch.int32), *gradients, len(layout.levels), float(stop), count,
        BASIS=width // 3, N=triton.next_power_of_2(width), LIMITED=limited, MANY=layout.coarser is not None, BLOCK=RAYS,
        num_warps=1,
    )  # fmt: skip


class _Trace(torch.autograd.Function):
    """The light of learnt leaves; the backward pass walks the rays again."""

    @staticmethod
    def forward(
        ctx: Any, raw: Tensor, coefficients: Tensor, layout: OctreeLayout, rays: Rays, background: Tensor, stop: float,
        peaks: Tensor | None,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        out = outputs_of(rays)[0]
        _run(layout, rays, stop, None, raw, None, coefficients, (None, None), background, out, peaks)
        ctx.save_for_backward(raw, coefficients, out.color, out.opacity)
        ctx.layout, ctx.rays, ctx.stop = layout, rays, stop
        ctx.mark_non_differentiable(out.moment, out.median, out.visits)
        ctx.set_materialize_grads(False)
        return tuple(out)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        raw, coefficients, color, opacity = ctx.saved_tensors
        of_color = torch.zeros_like(color) if grads[0] is None else grads[0].contiguous()
        of_opacity = None if grads[1] is None else grads[1].contiguous()
        found = torch.zeros_like(raw), torch.zeros_like(coefficients)
        known = color, opacity, None, None, None
        _run(
            ctx.layout, ctx.rays, ctx.stop, None, raw, None, coefficients, (None, None), None, known, None,
            (of_color, of_opacity, *found),
        )  # fmt: skip
        return (*found, None, None, None, None, None)


def trace_octree(
    layout: OctreeLayout, raw: Tensor, coefficients: Tensor, rays: Rays, background: Tensor, stop: float = 0.0,
    deferred: tuple[RowGradient, RowGradient] | None = None, peaks: Tensor | None = None,
) -> OctreeLight:  # fmt: skip
    """Compute `trace.trace_octree` of `layout`, `raw`, `coefficients`, `rays`, `background`, `stop` and `peaks`.

    Autograd accumulates the gradients of the leaves: `deferred` is not used.
    """
    inputs = raw.contiguous(), coefficients.contiguous()
    return OctreeLight(*_Trace.apply(*inputs, layout, contiguous(rays), background.contiguous(), stop, peaks))


def trace_packed(
    layout: OctreeLayout, leaves: PackedLeaves, rays: Rays, background: Tensor, stop: float = 0.0
) -> OctreeLight:
    """Compute `packed.trace_packed` of `layout`, `leaves`, `rays`, `background` and `stop`."""
    smallest, rays = smallest_cells(rays), contiguous(rays)
    out = outputs_of(rays)[0]
    _run(
        layout, rays, stop, smallest, leaves.codes, leaves.table, leaves.colors, (leaves.scales, leaves.offsets),
        background.contiguous(), out, None,
    )  # fmt: skip
    return out


def raise_weights(layout: OctreeLayout, raw: Tensor, rays: Rays, weights: Tensor, stop: float = 0.0) -> Tensor:
    """Compute `weights.raise_weights` of `layout`, `raw`, `rays`, `weights` and `stop`."""
    rays, opacity = contiguous(rays), torch.empty_like(rays.fars)
    out = None, opacity, None, None, None
    _run(layout, rays, stop, None, raw.contiguous(), None, None, (None, None), None, out, weights)
    return opacity
