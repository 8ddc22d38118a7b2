"""Pixels that no ray leads to: a lens's polynomial may fold the picture over before its corners are reached."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from framework.cameras import Cameras
from framework.console import say

BLOCK = 1 << 20
"""Pixels looked at together."""
SURE = 0.99
"""Of the distance within which a lens surely has a ray for every place, the part that is not looked at."""


@torch.no_grad()
def unreachable_pixels(cameras: Cameras) -> Tensor:
    """(K,) int64 pixels, counted through all images, whose centre no ray leads to. Their rays are finite, but wrong.

    Only places are tried that a lens is not sure to have a ray for: mostly none.
    """
    none = torch.zeros(0, dtype=torch.int64, device=cameras.fx.device)
    if cameras.model in ("pinhole", "orthographic"):
        return none
    lost = [none]
    for index in range(len(cameras)):
        if _doubtful(cameras, index):
            for pixels in cameras.image_pixels(index).split(BLOCK):
                lost.append(pixels[~_reached(cameras, index, pixels)])
    return torch.cat(lost)


def pixels_with_rays(cameras: Cameras, names: Sequence[str], split: str) -> Tensor | None:
    """The pixels (K,) int64 that a ray leads to, for `Dataset.drawn`; None for all. How many it does not is said.

    Args:
        names: the cameras' photographs.
        split: what to call them together.
    """
    lost = unreachable_pixels(cameras)
    if not len(lost):
        return None
    total = int(cameras.offsets[-1])
    counts = torch.bincount(torch.searchsorted(cameras.offsets, lost, right=True) - 1, minlength=len(cameras))
    worst = int(counts.argmax())
    say(
        f"split '{split}': the {cameras.model} lens has no ray for {len(lost)} of {total} pixels "
        f"({100 * len(lost) / total:.2g} %), on {int((counts > 0).sum())} of {len(cameras)} images, most on "
        f"{names[worst]} ({int(counts[worst])}); they are not trained on"
    )
    reached = torch.ones(total, dtype=torch.bool, device=lost.device)
    reached[lost] = False
    return reached.nonzero().squeeze(-1)


def _doubtful(cameras: Cameras, index: int) -> bool:
    """Whether a camera's corners are not sure to have a ray."""
    width, height = cameras.widths[index : index + 1], cameras.heights[index : index + 1]
    columns, rows = torch.stack([0 * width, width - 1]).float(), torch.stack([0 * height, height - 1]).float()
    columns, rows = columns.repeat(2, 1)[:, 0], rows.repeat_interleave(2, 0)[:, 0]
    x, y, seen = cameras.look(torch.full((4,), index, device=width.device), columns, rows)
    if cameras.distortion is None:
        return not bool(seen.found.all())
    return not bool((torch.hypot(x, y) < SURE * cameras.distortion.bounds[index, 0]).all())


def _reached(cameras: Cameras, index: int, pixels: Tensor) -> Tensor:
    """(P,) bool: whether rays lead to pixels of a camera."""
    within, width = pixels - cameras.offsets[index], cameras.widths[index]
    columns, rows = within % width, within // width
    reached = torch.ones_like(pixels, dtype=torch.bool)
    doubtful = reached
    if cameras.distortion is not None:
        x = (columns + 0.5 - cameras.cx[index]) / cameras.fx[index]
        y = (rows + 0.5 - cameras.cy[index]) / cameras.fy[index]
        doubtful = torch.hypot(x, y) >= SURE * cameras.distortion.bounds[index, 0]
    found = cameras.look(torch.full_like(pixels, index)[doubtful], columns[doubtful], rows[doubtful])[2].found
    return reached.masked_scatter(doubtful, found)
