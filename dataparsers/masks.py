"""Masks beside photographs: which file is the mask of which image."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePath

from dataparsers.captured import REDUCED
from framework.base.console import say


def find_masks(root: Path, names: Sequence[str]) -> tuple[Path | None, ...] | None:
    """The masks of M images; None where no image has one.

    A mask is called as its image, or as that with .png after it (COLMAP) or instead of its ending.

    Args:
        root: the folder of masks at full size; reduced ones are in folders beside it, as in masks_2.
        names: M image names below the folder of images.
    Returns: files below `root`, even where only reduced ones are there.
    """
    there: set[str] = set()
    for step in REDUCED:
        folder = root if step == 1 else root.with_name(f"{root.name}_{step}")
        there |= {file.relative_to(folder).as_posix() for file in folder.rglob("*")}
    masks = []
    for name in names:
        candidates = (name, f"{name}.png", PurePath(name).with_suffix(".png").as_posix())
        masks.append(next((root / candidate for candidate in candidates if candidate in there), None))
    without = [name for name, mask in zip(names, masks, strict=True) if mask is None]
    if len(without) == len(masks):
        return None
    if without:
        say(f"{root}: {len(without)} of {len(masks)} images have no mask and are used whole, the first {without[0]}")
    return tuple(masks)
