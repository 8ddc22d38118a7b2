"""The same part of the same view by every contender, beside the photograph and with its error."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as iio
import numpy as np

from framework.evaluation.images import error_map

VIEWS = 3
"""Views shown."""
CROP_SHARE = 4
"""A crop's edge is this part of the picture's shorter side."""
LEAST_CROP = 32
"""Pixels of a crop's edge at least, where the picture has them."""
PHOTOGRAPH = "_photograph.png"
"""How a photograph's file ends; its render's ends in .png alone."""


@dataclass(frozen=True)
class Strip:
    """One view by one contender, as data URIs of PNGs."""

    label: str
    whole: str
    crop: str
    error: str
    """Of the crop: black, red, yellow, white."""


@dataclass(frozen=True)
class View:
    """One view by all."""

    name: str
    photograph: str
    """With the crop's place framed."""
    crop: str
    strips: tuple[Strip, ...]


def views(folders: Sequence[tuple[str, Path]], count: int = VIEWS) -> list[View]:
    """Some views that all contenders have rendered, evenly spread.

    Args:
        folders: label and folder of renders and their photographs of each contender.
    """
    names = [{file.name.removesuffix(PHOTOGRAPH) for file in folder.glob("*" + PHOTOGRAPH)} for _, folder in folders]
    shared = sorted(set.intersection(*names)) if names else []
    count = min(count, len(shared))
    chosen = [shared[index * len(shared) // count] for index in range(count)]
    return [view for view in (_view(name, folders) for name in chosen) if view is not None]


def _view(name: str, folders: Sequence[tuple[str, Path]]) -> View | None:
    try:
        photograph = np.asarray(iio.imread(folders[0][1] / (name + PHOTOGRAPH)))[..., :3]
        renders = [np.asarray(iio.imread(folder / f"{name}.png"))[..., :3] for _, folder in folders]
    except (OSError, ValueError):
        return None
    if {render.shape for render in renders} != {photograph.shape}:
        return None
    wrong = np.mean([np.abs(render.astype(float) - photograph).mean(-1) for render in renders], axis=0)
    top, left, edge = worst_square(wrong)
    part = (slice(top, top + edge), slice(left, left + edge))
    framed = photograph.copy()
    for rows in (part[0].start, part[0].stop - 1):
        framed[rows, part[1]] = (255, 0, 160)
    for columns in (part[1].start, part[1].stop - 1):
        framed[part[0], columns] = (255, 0, 160)
    return View(
        name,
        data_uri(framed),
        data_uri(photograph[part]),
        tuple(
            Strip(label, data_uri(render), data_uri(render[part]), data_uri(error_map(render[part], photograph[part])))
            for (label, _), render in zip(folders, renders, strict=True)
        ),
    )


def worst_square(wrong: np.ndarray) -> tuple[int, int, int]:
    """Top, left and edge of the square with the largest sum of errors (H, W) in it."""
    height, width = wrong.shape
    edge = min(max(min(height, width) // CROP_SHARE, LEAST_CROP), height, width)
    sums = np.pad(wrong, ((1, 0), (1, 0))).cumsum(0).cumsum(1)
    inside = sums[edge:, edge:] - sums[:-edge, edge:] - sums[edge:, :-edge] + sums[:-edge, :-edge]
    top, left = np.unravel_index(int(inside.argmax()), inside.shape)
    return int(top), int(left), edge


def data_uri(image: np.ndarray) -> str:
    """(H, W, 3) uint8 as a PNG that a page can hold."""
    file = io.BytesIO()
    iio.imwrite(file, image, extension=".png")
    return "data:image/png;base64," + base64.b64encode(file.getvalue()).decode()
