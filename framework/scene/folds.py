"""Folded reconstructions: opposite sides of an object that are placed on one, because something repeats.

A label that is printed twice around a can looks the same from both sides. Matching then takes one side for the other,
and reprojection errors stay small, as all that is seen of the label fits. What is behind it does not: cameras in the
same position show different rooms, which a radiance field can only explain by fog before each of them (Cai et al.
2023, "Doppelgangers"). In a sequence of photographs a fold leaves a trace: neighbours that look alike, and whose
cameras look in quite different directions.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np

SIDE = 16
"""Rows and columns of a thumbnail."""
FEWEST = 12
"""Minimum number of photographs of a sequence."""
SEQUENCE = 0.75
"""Maximum difference between neighbours of a sequence, in units of the difference between distant ones (medians)."""
ALIKE = 1.5
"""Maximum difference between neighbours that look alike, in units of the median difference between neighbours."""
TURN, TURNS = 75.0, 6.0
"""Minimum angle between the cameras of a fold: degrees, and in units of the median angle between neighbours. What is
printed four times around an object folds by 90 degrees."""


def thumbnail(image: np.ndarray) -> np.ndarray:
    """Return an image's luminance in `SIDE` rows and columns, with mean 0 and standard deviation 1.

    Args:
        image: (H, W, 3 or more) of any numeric type, with `SIDE` rows and columns or more.

    Returns:
        (SIDE^2,) float32; 0 for an image of one colour.
    """
    step = max(min(image.shape[:2]) // (4 * SIDE), 1)
    light = image[::step, ::step, :3].mean(-1, dtype=np.float32)
    starts = [np.arange(SIDE) * size // SIDE for size in light.shape]
    sums = np.add.reduceat(np.add.reduceat(light, starts[0], axis=0), starts[1], axis=1)
    counts = np.outer(*(np.diff(start, append=size) for start, size in zip(starts, light.shape, strict=True)))
    small = (sums / np.maximum(counts, 1)).ravel()  # an image of fewer rows or columns repeats some
    small -= small.mean()
    return (small / max(float(small.std()), 1e-6)).astype(np.float32)


def in_order(names: Sequence[str]) -> list[int]:
    """Return the indices of file `names` in the order in which photographs are taken: numbers count as numbers."""
    parts = [re.split(r"(\d+)", name) for name in names]
    keys = [[int(part) if odd % 2 else part for odd, part in enumerate(each)] for each in parts]
    return sorted(range(len(names)), key=lambda index: keys[index])


def folds(names: Sequence[str], directions: np.ndarray, thumbnails: np.ndarray) -> list[tuple[int, int]]:
    """Return the pairs of neighbours that look alike, and whose cameras look in quite different directions.

    Args:
        names: M file names, whose order (`in_order`) is that of the sequence.
        directions: (M, 3) unit vectors, in which the cameras look.
        thumbnails: (M, D) `thumbnail` of each photograph.

    Returns:
        Indices of both photographs of each pair. None if the photographs are no sequence, in which neighbours look more
        alike than distant ones do.
    """
    if len(names) < FEWEST:
        return []
    order = np.array(in_order(names))
    ahead, seen = directions[order], thumbnails[order]
    turns = np.degrees(np.arccos(np.clip((ahead[1:] * ahead[:-1]).sum(-1), -1, 1)))
    differences, half = _differences(seen[1:], seen[:-1]), len(order) // 2
    usual = float(np.median(differences))
    if usual > SEQUENCE * float(np.median(_differences(seen[half:], seen[: len(order) - half]))):
        return []
    found = (turns > max(TURN, TURNS * float(np.median(turns)))) & (differences <= ALIKE * usual)
    return [(int(order[index]), int(order[index + 1])) for index in np.flatnonzero(found)]


def angle_between(first: np.ndarray, second: np.ndarray) -> float:
    """Return the angle between two unit vectors, `first` (3,) and `second` (3,), degrees."""
    return math.degrees(math.acos(min(max(float(first @ second), -1.0), 1.0)))


def _differences(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the root mean square of the differences (N,) between thumbnails (N, D)."""
    return np.sqrt(np.square(first - second).mean(-1))
