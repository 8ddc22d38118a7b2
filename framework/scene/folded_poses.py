"""Folded reconstructions: opposite sides of an object placed on top of each other, because a pattern repeats.

A label printed twice around a can looks the same from both sides. Matching may then confuse the sides. Reprojection
errors stay small, because the visible part of the label fits. The surroundings do not fit: cameras at the same position
show different rooms, which a radiance field can only explain by fog before each of them (Cai et al. 2023,
"Doppelgangers"). In a sequence of photographs a fold leaves a trace: neighbours that look alike although their cameras
look in very different directions.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np

THUMBNAIL_SIDE = 16
"""Rows and columns of a thumbnail."""
MIN_PHOTOGRAPHS = 12
"""Minimum number of photographs in a sequence."""
MAX_SEQUENCE_DIFFERENCE = 0.75
"""Maximum difference between neighbours in a sequence, relative to the difference between distant ones (medians)."""
MAX_DIFFERENCE_ALIKE = 1.5
"""Maximum difference between neighbours that look alike, relative to the median difference between neighbours."""
MIN_TURN, MIN_RELATIVE_TURN = 75.0, 6.0
"""Minimum angle between the cameras of a fold: in degrees, and relative to the median angle between neighbours. A
pattern printed four times around an object folds by 90 degrees."""


def thumbnail(image: np.ndarray) -> np.ndarray:
    """Return an image's luminance in `THUMBNAIL_SIDE` rows and columns, with mean 0 and standard deviation 1.

    Args:
        image: (H, W, 3 or more) of any numeric type.

    Returns:
        (THUMBNAIL_SIDE^2,) float32; 0 for an image of one colour.
    """
    step = max(min(image.shape[:2]) // (4 * THUMBNAIL_SIDE), 1)
    light = image[::step, ::step, :3].mean(-1, dtype=np.float32)
    starts = [np.arange(THUMBNAIL_SIDE) * size // THUMBNAIL_SIDE for size in light.shape]
    sums = np.add.reduceat(np.add.reduceat(light, starts[0], axis=0), starts[1], axis=1)
    counts = np.outer(*(np.diff(start, append=size) for start, size in zip(starts, light.shape, strict=True)))
    small = (sums / np.maximum(counts, 1)).ravel()  # smaller images repeat some rows or columns
    small -= small.mean()
    return (small / max(float(small.std()), 1e-6)).astype(np.float32)


def in_order(names: Sequence[str]) -> list[int]:
    """Return the indices of file `names` in the order of taking: numbers in names sort by value."""
    parts = [re.split(r"(\d+)", name) for name in names]
    keys = [[int(part) if odd % 2 else part for odd, part in enumerate(each)] for each in parts]
    return sorted(range(len(names)), key=lambda index: keys[index])


def folded_neighbours(names: Sequence[str], directions: np.ndarray, thumbnails: np.ndarray) -> list[tuple[int, int]]:
    """Return the pairs of neighbours that look alike although their cameras look in very different directions.

    Args:
        names: M file names; their order (`in_order`) is the sequence's.
        directions: (M, 3) unit viewing directions of the cameras.
        thumbnails: (M, D) `thumbnail` of each photograph.

    Returns:
        Indices of both photographs of each pair. Empty if the photographs are not a sequence, where neighbours look
        more alike than distant photographs.
    """
    if len(names) < MIN_PHOTOGRAPHS:
        return []
    order = np.array(in_order(names))
    ahead, seen = directions[order], thumbnails[order]
    turns = np.degrees(np.arccos(np.clip((ahead[1:] * ahead[:-1]).sum(-1), -1, 1)))
    differences, half = _differences(seen[1:], seen[:-1]), len(order) // 2
    usual = float(np.median(differences))
    if usual > MAX_SEQUENCE_DIFFERENCE * float(np.median(_differences(seen[half:], seen[: len(order) - half]))):
        return []
    turned = turns > max(MIN_TURN, MIN_RELATIVE_TURN * float(np.median(turns)))
    found = turned & (differences <= MAX_DIFFERENCE_ALIKE * usual)
    return [(int(order[index]), int(order[index + 1])) for index in np.flatnonzero(found)]


def angle_between(first: np.ndarray, second: np.ndarray) -> float:
    """Return the angle between two unit vectors, `first` (3,) and `second` (3,), degrees."""
    return math.degrees(math.acos(min(max(float(first @ second), -1.0), 1.0)))


def _differences(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the root-mean-square differences (N,) between thumbnails (N, D)."""
    return np.sqrt(np.square(first - second).mean(-1))
