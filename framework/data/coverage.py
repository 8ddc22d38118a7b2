"""Pixels without a ray: a lens polynomial may fold the image over before its corners."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor

from nerfloom.base.console import say
from nerfloom.base.errors import DataError
from nerfloom.cameras.cameras import Cameras
from nerfloom.data.pixels.pixel_set import PixelSet

BLOCK = 1 << 20
"""Number of pixels tested at once."""
UNTESTED_RADIUS = 0.99
"""Positions within this fraction of the lens's radius have a ray for certain and are not tested."""


@torch.no_grad()
def unreachable_pixels(cameras: Cameras) -> Tensor:
    """Return the pixels (K,) int64 with no ray through their centre, counted over all images.

    Rays computed for such pixels are finite but wrong. Only positions beyond a radius that is known to be safe are
    tested, usually none. Cameras with equal intrinsics are tested once.

    Args:
        cameras: cameras of any model.
    """
    none = torch.zeros(0, dtype=torch.int64, device=cameras.fx.device)
    if cameras.model in ("pinhole", "orthographic"):
        return none
    unreachable = [none]
    results: dict[tuple[float, ...], Tensor] = {}
    for index, intrinsics in enumerate(_intrinsics(cameras)):
        if intrinsics not in results:
            parts = cameras.image_pixels(index).split(BLOCK) if _may_lack_rays(cameras, index) else ()
            valid = [pixels[~_have_rays(cameras, index, pixels)] for pixels in parts]
            results[intrinsics] = torch.cat([none, *valid]) - cameras.offsets[index]
        unreachable.append(results[intrinsics] + cameras.offsets[index])
    return torch.cat(unreachable)


def pixels_with_rays(cameras: Cameras, names: Sequence[str], split: str) -> PixelSet | None:
    """Return the pixels that have a ray, or None for all; report the number of pixels without one.

    Args:
        cameras: cameras of any model.
        names: file names of the cameras' images.
        split: name of the split in messages.

    Raises:
        DataError: if no pixel has a ray.
    """
    unreachable = unreachable_pixels(cameras)
    if not len(unreachable):
        return None
    total = int(cameras.offsets[-1])
    if len(unreachable) == total:
        raise DataError(
            f"split '{split}': the {cameras.model} lens has no ray for any pixel; its focal lengths, principal point "
            "or distortion coefficients are wrong"
        )
    counts = torch.bincount(torch.searchsorted(cameras.offsets, unreachable, right=True) - 1, minlength=len(cameras))
    worst = int(counts.argmax())
    say(
        f"split '{split}': the {cameras.model} lens has no ray for {len(unreachable)} of {total} pixels "
        f"({100 * len(unreachable) / total:.2g} %), on {int((counts > 0).sum())} of {len(cameras)} images, most on "
        f"{names[worst]} ({int(counts[worst])}); these pixels are skipped"
    )
    sets = []
    ends = torch.searchsorted(unreachable, cameras.offsets).tolist()
    for (first, last), (low, high) in zip(pairwise(cameras.offsets.tolist()), pairwise(ends), strict=True):
        reached = torch.ones(last - first, dtype=torch.bool, device=unreachable.device)
        reached[unreachable[low:high] - first] = False
        sets.append(PixelSet.of_mask(reached, first))
    return PixelSet.joined(sets)


def _intrinsics(cameras: Cameras) -> list[tuple[float, ...]]:
    """Return, for each camera, the numbers that determine which of its pixels have a ray."""
    numbers = [cameras.fx, cameras.fy, cameras.cx, cameras.cy, cameras.widths, cameras.heights]
    lens = [] if cameras.lens is None else list(cameras.lens.unbind(-1))
    return list(zip(*(values.tolist() for values in numbers + lens), strict=True))


def _may_lack_rays(cameras: Cameras, index: int) -> bool:
    """Return whether the corners of a camera's image may lack a ray."""
    width, height = cameras.widths[index : index + 1], cameras.heights[index : index + 1]
    columns, rows = torch.stack([0 * width, width - 1]).float(), torch.stack([0 * height, height - 1]).float()
    columns, rows = columns.repeat(2, 1)[:, 0], rows.repeat_interleave(2, 0)[:, 0]
    x, y, rays = cameras.look(torch.full((4,), index, device=width.device), columns, rows)
    if cameras.distortion is None:
        return not bool(rays.valid.all())
    return not bool((torch.hypot(x, y) < UNTESTED_RADIUS * cameras.distortion.bounds[index, 0]).all())


def _have_rays(cameras: Cameras, index: int, pixels: Tensor) -> Tensor:
    """Return whether pixels (P,) of a camera have a ray, (P,) bool."""
    within, width = pixels - cameras.offsets[index], cameras.widths[index]
    columns, rows = within % width, within // width
    if cameras.distortion is None:
        return cameras.look(torch.full_like(pixels, index), columns, rows)[2].valid
    x = (columns + 0.5 - cameras.cx[index]) / cameras.fx[index]
    y = (rows + 0.5 - cameras.cy[index]) / cameras.fy[index]
    distance, (inner, outer) = torch.hypot(x, y), cameras.distortion.bounds[index]
    reached = distance < UNTESTED_RADIUS * inner
    doubtful = ~reached & (distance <= outer)
    valid = cameras.look(torch.full_like(pixels, index)[doubtful], columns[doubtful], rows[doubtful])[2].valid
    return reached.masked_scatter(doubtful, valid)
