"""Blending of Gaussians on an image, from front to back (Kerbl et al. 2023, equation 3).

    alpha_i = min(opacity_i exp(-u_i^2 - v_i^2), MAX_ALPHA), or 0 where that is below MIN_ALPHA
    T_i     = prod_{j < i} (1 - alpha_j)               transmittance in front of it
    image   = sum_i alpha_i T_i value_i + T background

A pixel is finished when its transmittance is below OPAQUE: no value can change by more than this share of its range.

The backward pass also runs from front to back. The light from behind a Gaussian is the whole image minus everything up
to this Gaussian, so T is not divided by 1 - alpha at each step. Each entry of a tile's list has its own sums, which are
added by Gaussian in a fixed order: no two threads write to the same place, and the result has the same bits with any
number of threads.

Growth needs the magnitude of the pixels' gradients for a Gaussian, even where gradients of opposite sign cancel (AbsGS,
Ye et al. 2024). So every implementation stores the sums over pixels of the absolute gradients of the centre. They are
in two columns of the records' gradient that are unused, because the image does not depend on these columns:

    gradient[ABSOLUTE_X] = sum_p |d loss / d x through pixel p|        gradient[ABSOLUTE_Y] likewise of y
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from nerfloom.kernels import native
from nerfloom.kernels.dispatch import CPP, FEW_OPERATIONS, TRITON, Operation
from nerfloom.kernels.splats.project import RECORD, Record
from nerfloom.kernels.splats.tiles import TILE, TileLists
from nerfloom.kernels.triton_backend import later

ABSOLUTE_X, ABSOLUTE_Y = Record.CUT, Record.REACH_X
"""Columns of the records' gradient with the sums of absolute gradients of x and y."""
MAX_ALPHA = 0.999
"""No Gaussian is more opaque: the gradient divides by 1 - alpha."""
OPAQUE = 1e-4
"""A pixel is finished below this transmittance."""
MAX_PAIRS = 2**24
"""Maximum number of pairs of a Gaussian and a pixel in memory, in the form with few operations."""
CHANNELS = {"rgb": 3, "distance": 4, "normals": 7}
"""Content of an image -> number of channels: colours, then weighted distance, then weighted normals."""


class Blended(NamedTuple):
    """The Gaussians on an image, blended."""

    image: Tensor
    """(H, W, C) colours over the background, then, if asked for, the sums of weight times distance and of weight times
    normal."""
    transmittance: Tensor
    """(H, W) share of the background's light that arrives."""
    median: Tensor | None
    """(H, W) distance from the camera where transmittance falls to 1/2 or below, 0 if it never does; None if not
    requested."""


def blend(
    records: Tensor, lists: TileLists, width: int, height: int, background: Tensor, channels: int = 3,
    median: bool = False,
) -> Blended:  # fmt: skip
    """Blend the Gaussians on an image.

    Columns ABSOLUTE_X and ABSOLUTE_Y of the records' gradient hold sums of absolute gradients.

    Args:
        records: (N, RECORD) Gaussians on the image.
        lists: Gaussians that each tile may show, with slots if there is to be a gradient.
        width, height: size of the image, pixels.
        background: (3,) colour behind everything. It gets no gradient.
        channels: number of channels, a value of `CHANNELS`. Normals have a gradient only in the reference.
        median: whether to find the median distance. It has no gradient.
    """
    background = background.detach()
    return BLEND((records, background), records, lists, width, height, background, channels, median)


def blend_reference(
    records: Tensor, lists: TileLists, width: int, height: int, background: Tensor, channels: int, median: bool
) -> Blended:
    """Compute `blend` of `records`, `lists`, `width`, `height`, `background`, `channels` and `median` tile by tile."""
    columns, rows = -(-width // TILE), -(-height // TILE)
    behind = torch.cat([background.to(records), records.new_zeros(channels - 3)])
    tiles, left, middles = [], [], []
    for tile in range(columns * rows):
        listed, weights, through = _weights(records, lists, tile, columns)
        rest = 1 - weights.sum(1)
        tiles.append(weights @ listed[:, Record.RED : Record.RED + channels] + rest[:, None] * behind)
        left.append(rest)
        crossed = (through[:, :-1] > 0.5) & (through[:, 1:] <= 0.5)
        middles.append((crossed * listed[:, Record.DISTANCE]).sum(1).detach())

    def joined(parts: list[Tensor]) -> Tensor:
        grid = torch.stack(parts).view(rows, columns, TILE, TILE, -1).permute(0, 2, 1, 3, 4)
        return grid.reshape(rows * TILE, columns * TILE, -1)[:height, :width]

    return Blended(joined(tiles), joined(left)[..., 0], joined(middles)[..., 0] if median else None)


def _weights(records: Tensor, lists: TileLists, tile: int, columns: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return records (M, RECORD) of a tile's list, weights (P, M) in its P pixels, and transmittances (P, M + 1)."""
    first, last = lists.offsets[tile : tile + 2].tolist()
    listed = records[lists.ids[first:last].long()]
    within = torch.arange(TILE, device=records.device)
    offset_y, offset_x = (part.flatten() for part in torch.meshgrid(within, within, indexing="ij"))
    x = (tile % columns * TILE + offset_x).to(records.dtype) + 0.5
    y = (tile // columns * TILE + offset_y).to(records.dtype) + 0.5
    dx, dy = _offsets(listed[None], x, y)
    q = _exponent(listed, dx, dy)
    alpha = (listed[:, Record.OPACITY] * torch.exp(-q)).clamp(max=MAX_ALPHA)
    alpha = alpha.masked_fill(q >= listed[:, Record.CUT], 0)
    through = torch.cat([torch.ones_like(alpha[:, :1]), (1 - alpha).cumprod(1)], 1)
    return listed, (alpha * through[:, :-1]).masked_fill(through[:, :-1] < OPAQUE, 0), through


def _offsets(listed: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Return the offsets dx, dy (..., P, M) of pixels x, y (..., P) from Gaussians (..., 1, M, RECORD)."""
    pixels = x.shape[-1]
    center_x = _OfEachPixel.apply(listed[..., Record.X], listed[..., ABSOLUTE_X], pixels)
    center_y = _OfEachPixel.apply(listed[..., Record.Y], listed[..., ABSOLUTE_Y], pixels)
    return x[..., None] - center_x, y[..., None] - center_y


def _exponent(listed: Tensor, dx: Tensor, dy: Tensor) -> Tensor:
    """Return u^2 + v^2 (..., P, M) at offsets from Gaussians (..., M, RECORD); alpha falls by exp(-u^2 - v^2)."""
    along_x, along_y = listed[..., Record.U_X] * dx, listed[..., Record.U_Y] * dy
    return (along_x + along_y) ** 2 + (listed[..., Record.V_Y] * dy) ** 2


class _OfEachPixel(torch.autograd.Function):
    """Give each pixel a coordinate (..., P, M) of its own. Backwards, their gradients are added up, (..., 1, M), and so
    are their absolute values, which go to another column."""

    @staticmethod
    def forward(ctx: Any, coordinate: Tensor, absolute: Tensor, pixels: int) -> Tensor:
        return coordinate.expand(*coordinate.shape[:-2], pixels, coordinate.shape[-1])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, None]:
        return grads[0].sum(-2, keepdim=True), grads[0].abs().sum(-2, keepdim=True), None


def _blend_together(
    records: Tensor, lists: TileLists, width: int, height: int, background: Tensor, channels: int, median: bool
) -> Blended:
    """Compute `blend` for many tiles at once; tiles with lists of similar lengths go together.

    Synchronises once, for the lengths. If not all tiles fit into memory, the backward pass computes them again.
    """
    columns, rows = -(-width // TILE), -(-height // TILE)
    behind = torch.nn.functional.pad(background.to(records), (0, channels - 3))
    lengths, order = lists.offsets.diff().sort(descending=True)
    longest, first, parts = lengths.tolist(), 0, []
    whole = longest[0] * len(longest) * TILE**2 <= MAX_PAIRS
    run = (
        _blended_tiles if whole else partial(checkpoint, _blended_tiles, use_reentrant=False, preserve_rng_state=False)
    )
    while first < len(longest):
        last = first + max(MAX_PAIRS // (max(longest[first], 1) * TILE**2), 1)
        parts.append(run(records, lists, order[first:last], longest[first], columns, behind))
        first = last
    tiles = torch.cat(parts).index_select(0, order.argsort()).view(rows, columns, TILE, TILE, -1)
    image = tiles.permute(0, 2, 1, 3, 4).reshape(rows * TILE, columns * TILE, -1)[:height, :width]
    return Blended(image[..., :channels], image[..., channels], image[..., channels + 1].detach() if median else None)


def _blended_tiles(
    records: Tensor, lists: TileLists, tiles: Tensor, longest: int, columns: int, behind: Tensor
) -> Tensor:
    """Return channels, transmittance and median distance (T, P, C + 2) of the P pixels of T tiles."""
    place = torch.arange(longest, device=records.device)
    first, end = lists.offsets.index_select(0, tiles), lists.offsets.index_select(0, tiles + 1)
    entries = (first[:, None] + place).clamp(max=max(len(lists.ids) - 1, 0)).flatten()
    listed = records.index_select(0, lists.ids.index_select(0, entries)).view(len(tiles), 1, longest, RECORD)
    within = torch.arange(TILE, device=records.device) + 0.5
    x = ((tiles % columns * TILE)[:, None, None] + within).expand(-1, TILE, -1).flatten(1)
    y = ((tiles // columns * TILE)[:, None, None] + within[:, None]).expand(-1, -1, TILE).flatten(1)
    dx, dy = _offsets(listed, x.to(records.dtype), y.to(records.dtype))
    q = _exponent(listed, dx, dy)
    alpha = (listed[..., Record.OPACITY] * torch.exp(-q)).clamp(max=MAX_ALPHA)
    alpha = alpha.masked_fill((q >= listed[..., Record.CUT]) | (place >= (end - first)[:, None])[:, None], 0)
    # A sum of logarithms: the gradient of a product asks the device whether a factor is 0.
    through = torch.exp(torch.nn.functional.pad(torch.log1p(-alpha).cumsum(-1), (1, 0)))
    in_front = through[..., :-1]
    weights = (alpha * in_front).masked_fill(in_front < OPAQUE, 0)
    rest = 1 - weights.sum(-1, keepdim=True)
    values = weights @ listed[:, 0, :, Record.RED : Record.RED + len(behind)] + rest * behind
    crossed = (in_front > 0.5) & (through[..., 1:] <= 0.5)
    return torch.cat([values, rest, (crossed * listed[..., Record.DISTANCE]).sum(-1, keepdim=True)], -1)


def blended_pairs(records: Tensor, lists: TileLists, width: int, height: int) -> int:
    """Return the number of pairs of a pixel and a Gaussian blended into it, for measurements.

    Args:
        records: (N, RECORD) Gaussians on the image.
        lists: Gaussians that each tile may show.
        width, height: size of the image, pixels.
    """
    columns, rows = -(-width // TILE), -(-height // TILE)
    total = 0
    for tile in range(columns * rows):
        weights = _weights(records.detach(), lists, tile, columns)[1].view(TILE, TILE, -1)
        inside = weights[: height - tile // columns * TILE, : width - tile % columns * TILE]
        total += int((inside > 0).sum())
    return total


BLEND = Operation("blend", blend_reference)
BLEND.implementation(FEW_OPERATIONS, types=None, order=torch.inf)(_blend_together)
_forward = native.Function("splat_blend", "pqppqiiippppppi")
_backward = native.Function("splat_blend_backward", "pqpppqiiippppppp" + "i")
_gather = native.Function("splat_gather", "pqpqppi")


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, records: Tensor, lists: TileLists, width: int, height: int, background: Tensor, channels: int,
        median: bool,
    ) -> tuple[Tensor, Tensor, Tensor | None]:  # fmt: skip
        image, through = records.new_empty(height, width, channels), records.new_empty(height, width)
        middle = records.new_empty(height, width) if median else None
        blocks = torch.empty(len(lists.ids), dtype=torch.int64) if ctx.needs_input_grad[0] else None
        used = torch.empty(len(lists.offsets) - 1, dtype=torch.int32)
        _forward(
            native.pointer(records, "the records", (len(records), RECORD)), len(records), lists.offsets.data_ptr(),
            lists.ids.data_ptr(), len(lists.ids), width, height, channels,
            native.pointer(background, "the background", (3,)), image.data_ptr(), through.data_ptr(),
            None if middle is None else middle.data_ptr(), None if blocks is None else blocks.data_ptr(),
            used.data_ptr(), native.threads(),
        )  # fmt: skip
        ctx.save_for_backward(records, *lists[:4], image, through, blocks, used)
        if middle is not None:
            ctx.mark_non_differentiable(middle)
        ctx.set_materialize_grads(False)
        return image, through, middle

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        records, offsets, ids, slots, firsts, image, through, blocks, used = ctx.saved_tensors
        height, width, channels = image.shape
        of_image = torch.zeros_like(image) if grads[0] is None else grads[0].contiguous()
        of_through = None if grads[1] is None else grads[1].contiguous()
        parts, out = records.new_empty(len(ids), RECORD), torch.empty_like(records)
        _backward(
            records.data_ptr(), len(records), offsets.data_ptr(), ids.data_ptr(),
            native.pointer(slots, "the slots, which lists `for_gradients` have,", (len(ids),), torch.int32), len(ids),
            width, height, channels, image.data_ptr(), through.data_ptr(), blocks.data_ptr(), used.data_ptr(),
            native.pointer(of_image, "the image's gradient", tuple(image.shape)),
            None if of_through is None else native.pointer(of_through, "the transmittance's", tuple(through.shape)),
            parts.data_ptr(), native.threads(),
        )  # fmt: skip
        _gather(records.data_ptr(), len(records), firsts.data_ptr(), len(ids), parts.data_ptr(), out.data_ptr(),
                native.threads())  # fmt: skip
        return out, None, None, None, None, None, None


def _gradients_there(
    records: Tensor, lists: TileLists, width: int, height: int, background: Tensor, channels: int, median: bool
) -> bool:
    return channels < CHANNELS["normals"] or not (torch.is_grad_enabled() and records.requires_grad)


@BLEND.implementation(CPP, fits=_gradients_there)
def _compiled(
    records: Tensor, lists: TileLists, width: int, height: int, background: Tensor, channels: int, median: bool
) -> Blended:
    return Blended(*_Blend.apply(records.contiguous(), lists, width, height, background.contiguous(), channels, median))


BLEND.implementation(TRITON, fits=_gradients_there)(later("splats.blend_triton", "blend"))
