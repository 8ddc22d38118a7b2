"""Masks in a folder beside the images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from nerfloom.base.console import say
from nerfloom.data.names_on_disk import REDUCED, companions_of, files_below, reduced_folder


def find_masks(root: Path, names: Sequence[str]) -> tuple[Path | None, ...] | None:
    """Return the masks of M images, or None if no image has one.

    A mask has the name of its image (`spelled`), with an additional (COLMAP) or another ending.

    Args:
        root: folder of masks at full size; reduced masks are in folders beside it, such as masks_2. If it is called
            masks and does not exist, mask is used, which is reported.
        names: M names of images, relative to the images' folder.

    Returns:
        Files in `root`, even if only reduced ones exist; None for an image without mask.
    """
    root = _existing(root)
    available = sorted({file for factor in REDUCED for file in files_below(reduced_folder(root, factor))})
    masks = [None if file is None else root / file for file in companions_of(names, available)]
    without = [name for name, mask in zip(names, masks, strict=True) if mask is None]
    if len(without) == len(masks):
        if available:
            say(f"{root}: none of its {len(available)} files is named like an image, such as {names[0]}; not used")
        return None
    if without:
        say(f"{root}: {len(without)} of {len(masks)} images have no mask and are used without, the first {without[0]}")
    return tuple(masks)


def _existing(root: Path) -> Path:
    """Return the folder `root` of masks, or its other name mask, at full size or reduced."""
    other = root.with_name("mask")
    is_there, is_other = (
        any(reduced_folder(folder, factor).is_dir() for factor in REDUCED) for folder in (root, other)
    )
    if root.name != "masks" or is_there or not is_other:
        return root
    say(f"{other}: used as the folder of masks: white for pixels to train on")
    return other
