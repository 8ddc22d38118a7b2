"""Crops of the same views by all contenders, beside the held-out images, with their errors."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as iio
import numpy as np

from nerfloom.base.evenly_spaced import strided
from nerfloom.evaluation.images import error_map
from nerfloom.evaluation.view_files import WORST

MAX_VIEWS = 3
"""Maximum number of views shown."""
CROP_SHARE = 4
"""Ratio of the image's shorter side to the side of a crop."""
MIN_CROP = 32
"""Minimum side of a crop, pixels, if the image is large enough."""
IMAGE_SUFFIX = "_photograph.png"
"""End of the file name of a held-out image; a render's file name ends in .png only."""


@dataclass(frozen=True)
class Strip:
    """One view by one contender, as data URIs of PNGs.

    Args:
        label: the contender's label.
        whole: the render.
        crop: the crop of the render.
    """

    label: str
    whole: str
    crop: str
    error: str
    """The crop's error as a heat map: black, red, yellow, white."""


@dataclass(frozen=True)
class View:
    """One view by all contenders, as data URIs of PNGs.

    Args:
        name: name of the view.
        crop: the crop of the held-out image.
        strips: renders of the contenders.
    """

    name: str
    image: str
    """The held-out image with the crop framed."""
    crop: str
    strips: tuple[Strip, ...]


def views(folders: Sequence[tuple[str, Path]], count: int = MAX_VIEWS) -> list[View]:
    """Return at most `count` views, evenly spaced, that are in each contender's folder of `folders`, by label."""
    names = [
        {file.name.removesuffix(IMAGE_SUFFIX) for file in folder.glob("*" + IMAGE_SUFFIX)} for _, folder in folders
    ]
    shared = sorted(set.intersection(*names) - {WORST}) if names else []  # the worst view differs between contenders
    chosen = (_view(shared[index], folders) for index in strided(len(shared), count))
    return [view for view in chosen if view is not None]


def _view(name: str, folders: Sequence[tuple[str, Path]]) -> View | None:
    try:
        image = np.asarray(iio.imread(folders[0][1] / (name + IMAGE_SUFFIX)))[..., :3]
        renders = [np.asarray(iio.imread(folder / f"{name}.png"))[..., :3] for _, folder in folders]
    except (OSError, ValueError):
        return None
    if {render.shape for render in renders} != {image.shape}:
        return None
    errors = np.mean([np.abs(render.astype(float) - image).mean(-1) for render in renders], axis=0)
    top, left, side = worst_square(errors)
    part = (slice(top, top + side), slice(left, left + side))
    framed = image.copy()
    for rows in (part[0].start, part[0].stop - 1):
        framed[rows, part[1]] = (255, 0, 160)
    for columns in (part[1].start, part[1].stop - 1):
        framed[part[0], columns] = (255, 0, 160)
    return View(
        name,
        data_uri(framed),
        data_uri(image[part]),
        tuple(
            Strip(label, data_uri(render), data_uri(render[part]), data_uri(error_map(render[part], image[part])))
            for (label, _), render in zip(folders, renders, strict=True)
        ),
    )


def worst_square(errors: np.ndarray) -> tuple[int, int, int]:
    """Return top, left and side of the square crop with the largest sum of `errors` (H, W)."""
    height, width = errors.shape
    side = min(max(min(height, width) // CROP_SHARE, MIN_CROP), height, width)
    sums = np.pad(errors, ((1, 0), (1, 0))).cumsum(0).cumsum(1)
    inside = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
    top, left = np.unravel_index(int(inside.argmax()), inside.shape)
    return int(top), int(left), side


def data_uri(image: np.ndarray) -> str:
    """Return `image` (H, W, 3) uint8 as the data URI of a PNG."""
    file = io.BytesIO()
    iio.imwrite(file, image, extension=".png")
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()
