"""Photographs that use a small part of their range: underexposed, foggy, or 12 bits in a file of 16.

Features are found by absolute differences of brightness, so such photographs have few. For features alone, brightness
is stretched to the whole range; what is written for training stays as it is.
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

NARROW = 0.3
"""Range of brightness below which it is stretched. Six photographs of a can that were darkened to a range of 0.29 had
2,987 matches that fit, stretched 4,199; at 0.14 664 and 4,097, at 0.09 none and 4,013; at their own 0.58 4,080 and
4,224."""
BLANK = 0.008
"""Range of brightness below which an image shows nothing: two of 255 levels."""
DARK = 0.1
"""Brightness below which an image that shows nothing is black."""


def for_features(folder: Path, prepared: list[PreparedImage], images: Path, target: Path) -> Path:
    """Return the folder of the images whose features are extracted, and say what is dark, foggy or blank.

    Args:
        folder: folder of the sources.
        prepared: the prepared images.
        images: folder of the prepared images; it is returned if none needs to be stretched.
        target: folder for stretched images, with links to the others.

    Raises:
        DataError: if fewer than two images show anything.
    """
    ranges = {image.name: image.tones[1] - image.tones[0] for image in prepared}
    blank = [image for image in prepared if ranges[image.name] < BLANK]
    narrow = {name for name, wide in ranges.items() if BLANK <= wide < NARROW}
    _report_blank(blank, len(prepared))
    if not narrow:
        return images
    middle = float(np.median([ranges[name] for name in narrow]))
    say(
        f"{len(narrow)} of {len(prepared)} images use a small part of the range of brightness ({middle:.0%} in the "
        "middle): too dark, foggy, or of few of 16 bits. Features are found in stretched copies; the "
        "images themselves stay as they are, and so does what is trained on"
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
        raise DataError(
            f"{len(blank)} of {count} images are {what}, as {first}: there is nothing to find in them.{why}"
        )
    say(f"{len(blank)} of {count} images are {what} and cannot be placed, the first: {first}")


def _link(source: Path, target: Path) -> None:
    try:
        os.link(source, target)
    except OSError:  # a file system without hard links
        shutil.copyfile(source, target)
