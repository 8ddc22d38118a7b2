"""Photographs with a small range of brightness: underexposed, foggy, or 12 bits in a 16-bit file.

Features are found by absolute differences of brightness, so such photographs have few. For feature detection only,
brightness is stretched to the full range; the images for training stay unchanged.
"""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
from PIL import Image

from nerfloom.base.console import say
from nerfloom.base.errors import DataError
from nerfloom.data.image_files import Content
from nerfloom.processing.brightness import stretched
from nerfloom.processing.images import OPERATIONS, PreparedImage, in_parallel, save

MIN_RANGE = 0.3
"""Images with a smaller range of brightness are stretched. Six photographs of a can darkened to a range of 0.29 had
2,987 verified matches, and 4,199 after stretching. At 0.14 they had 664 and 4,097, at 0.09 none and 4,013, and at their
own contrast of 0.58 4,080 and 4,224."""
BLANK = 0.008
"""An image with a smaller range of brightness is blank: two of 255 levels."""
DARK = 0.1
"""A blank image below this brightness is black."""


def for_features(folder: Path, prepared: list[PreparedImage], images: Path, target: Path) -> Path:
    """Return the folder of images for feature extraction, and report dark, foggy and blank images.

    Args:
        folder: folder of the sources.
        prepared: the prepared images.
        images: folder of the prepared images; it is returned if none needs to be stretched.
        target: folder for stretched images, with links to the others.

    Raises:
        DataError: if fewer than two images have any content.
    """
    ranges = {image.name: image.tones[1] - image.tones[0] for image in prepared}
    blank = [image for image in prepared if ranges[image.name] < BLANK]
    narrow = {name for name, wide in ranges.items() if BLANK <= wide < MIN_RANGE}
    _report_blank(blank, len(prepared))
    if not narrow:
        return images
    middle = float(np.median([ranges[name] for name in narrow]))
    say(
        f"{len(narrow)} of {len(prepared)} images have a small range of brightness (median {middle:.0%}): too dark, "
        "foggy, or few of 16 bits. Features are found in stretched copies; the "
        "images for training stay unchanged"
    )

    def write(entry: PreparedImage) -> None:
        path = target / entry.name
        path.parent.mkdir(parents=True, exist_ok=True)
        if entry.name not in narrow:
            _link(images / entry.name, path)
            return
        with Image.open(Content(folder / entry.source)) as image:
            grey = stretched(image)
        operation = OPERATIONS.get(entry.orientation)
        save(grey if operation is None else grey.transpose(operation), path)

    in_parallel(write, prepared, "Stretching brightness", len(prepared))
    return target


def _report_blank(blank: list[PreparedImage], count: int) -> None:
    if not blank:
        return
    first = blank[0].source
    dark = all(image.tones[1] < DARK for image in blank)
    what = "black" if dark else "of one colour"
    if len(blank) > count - 2:
        why = " Was the lens covered, or the exposure far too short?" if dark else ""
        raise DataError(f"{len(blank)} of {count} images are {what}, such as {first}: they have no features.{why}")
    say(f"{len(blank)} of {count} images are {what} and cannot be placed, the first: {first}")


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # a file system without hard links
        shutil.copyfile(source, target)
