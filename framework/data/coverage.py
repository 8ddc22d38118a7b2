"""Pixels that no ray leads to: a lens's polynomial may fold the picture over before its corners are reached."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor

from framework.base.console import say
from framework.base.errors import DataError
from framework.cameras.cameras import Cameras
from framework.data.pixel_set import PixelSet

BLOCK = 1 << 20
"""Pixels looked at together."""
SURE = 0.99
"""Of the distance within which a lens surely has a ray for every place, the part that is not looked at."""


@torch.no_grad()
def unreachable_pixels(cameras: Cameras) -> Tensor:
    """(K,) int64 pixels, counted through all images, whose centre no ray leads to. Their rays are finite, but wrong.

    Only places are tried that a lens is not sure to have a ray for, mostly none; and cameras that are alike, once.
    """
    none = torch.zeros(0, dtype=torch.int64, device=cameras.fx.device)
    if cameras.model in ("pinhole", "orthographic"):
        return none
    lost = [none]
    known: dict[tuple[float, ...], Tensor] = {}
    for index, kind in enumerate(_kinds(cameras)):
        if kind not in known:
            parts = cameras.image_pixels(index).split(BLOCK) if _doubtful(cameras, index) else ()
            valid = [pixels[~_reached(cameras, index, pixels)] for pixels in parts]
            known[kind] = torch.cat([none, *valid]) - cameras.offsets[index]
        lost.append(known[kind] + cameras.offsets[index])
    return torch.cat(lost)


def pixels_with_rays(cameras: Cameras, names: Sequence[str], split: str) -> PixelSet | None:
    """The pixels that a ray leads to; None for all. To how many none leads is said.

    Args:
        names: the cameras' photographs.
        split: what to call them together.
    Raises: DataError where no pixel is left.
    """
    lost = unreachable_pixels(cameras)
    if not len(lost):
        return None
    total = int(cameras.offsets[-1])
    if len(lost) == total:
        raise DataError(
            f"split '{split}': the {cameras.model} lens has no ray for any pixel; its focal lengths, principal point "
            "or distortion coefficients are wrong"
        )
    counts = torch.bincount(torch.searchsorted(cameras.offsets, lost, right=True) - 1, minlength=len(cameras))
    worst = int(counts.argmax())
    say(
        f"split '{split}': the {cameras.model} lens has no ray for {len(lost)} of {total} pixels "
        f"({100 * len(lost) / total:.2g} %), on {int((counts > 0).sum())} of {len(cameras)} images, most on "
        f"{names[worst]} ({int(counts[worst])}); they are not trained on"
    )
    sets = []
    ends = torch.searchsorted(lost, cameras.offsets).tolist()
    for (first, last), (low, high) in zip(pairwise(cameras.offsets.tolist()), pairwise(ends), strict=True):
        reached = torch.ones(last - first, dtype=torch.bool, device=lost.device)
        reached[lost[low:high] - first] = False
        sets.append(PixelSet.of_mask(reached, first))
    return PixelSet.joined(sets)


def _kinds(cameras: Cameras) -> list[tuple[float, ...]]:
    """Of each camera all that tells which of its pixels have a ray."""
    numbers = [cameras.fx, cameras.fy, cameras.cx, cameras.cy, cameras.widths, cameras.heights]
    lens = [] if cameras.lens is None else list(cameras.lens.unbind(-1))
    return list(zip(*(values.tolist() for values in numbers + lens), strict=True))


def _doubtful(cameras: Cameras, index: int) -> bool:
    """Whether a camera's corners are not sure to have a ray."""
    width, height = cameras.widths[index : index + 1], cameras.heights[index : index + 1]
    columns, rows = torch.stack([0 * width, width - 1]).float(), torch.stack([0 * height, height - 1]).float()
    columns, rows = columns.repeat(2, 1)[:, 0], rows.repeat_interleave(2, 0)[:, 0]
    x, y, seen = cameras.look(torch.full((4,), index, device=width.device), columns, rows)
    if cameras.distortion is None:
        return not bool(seen.valid.all())
    return not bool((torch.hypot(x, y) < SURE * cameras.distortion.bounds[index, 0]).all())


def _reached(cameras: Cameras, index: int, pixels: Tensor) -> Tensor:
    """(P,) bool: whether rays lead to pixels of a camera."""
    within, width = pixels - cameras.offsets[index], cameras.widths[index]
    columns, rows = within % width, within // width
    if cameras.distortion is None:
        return cameras.look(torch.full_like(pixels, index), columns, rows)[2].valid
    x = (columns + 0.5 - cameras.cx[index]) / cameras.fx[index]
    y = (rows + 0.5 - cameras.cy[index]) / cameras.fy[index]
    distance, (inner, outer) = torch.hypot(x, y), cameras.distortion.bounds[index]
    reached = distance < SURE * inner
    doubtful = ~reached & (distance <= outer)
    valid = cameras.look(torch.full_like(pixels, index)[doubtful], columns[doubtful], rows[doubtful])[2].valid
    return reached.masked_scatter(doubtful, valid)
