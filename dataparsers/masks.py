"""Masks in a folder beside the images: the mask of each image."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePath

from dataparsers.captured import REDUCED
from framework.base.console import say


def find_masks(root: Path, names: Sequence[str]) -> tuple[Path | None, ...] | None:
    """Return the masks of M images, or None if no image has one.

    A mask has the name of its image, with .png appended to it (COLMAP), or with .png in place of its suffix.

    Args:
        root: folder of masks at full size; reduced ones are in folders beside it, such as masks_2.
        names: M names of images, relative to the images' folder.

    Returns:
        Files in `root`, even if only reduced ones exist; None for an image without mask.
    """
    available: set[str] = set()
    for step in REDUCED:
        folder = root if step == 1 else root.with_name(f"{root.name}_{step}")
        available |= {file.relative_to(folder).as_posix() for file in folder.rglob("*")}
    masks = []
    for name in names:
        candidates = (name, f"{name}.png", PurePath(name).with_suffix(".png").as_posix())
        masks.append(next((root / candidate for candidate in candidates if candidate in available), None))
    without = [name for name, mask in zip(names, masks, strict=True) if mask is None]
    if len(without) == len(masks):
        return None
    if without:
        say(f"{root}: {len(without)} of {len(masks)} images have no mask and are used without, the first {without[0]}")
    return tuple(masks)
