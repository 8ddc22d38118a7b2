"""Quaternions by their three smallest components. Files leave the largest out, as it follows from unit length.

q and -q are the same rotation, so the largest component can be made positive. It is then the root of 1 minus the
squares of the others. These are at most sqrt(1/2).
"""

from __future__ import annotations

import numpy as np


def split(quaternions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the place (N,) of the largest component, and the others (N, 3) in their order, where it is positive.

    Args:
        quaternions: (N, 4), in any order of components, of any length.
    """
    unit = quaternions / np.maximum(np.linalg.norm(quaternions, axis=-1, keepdims=True), 1e-300)
    place = np.abs(unit).argmax(-1)
    largest = np.take_along_axis(unit, place[:, None], -1)
    others = unit[np.arange(4) != place[:, None]].reshape(-1, 3)
    return place, np.where(largest < 0, -others, others)


def joined(place: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return quaternions (N, 4) from the place of the largest component and the others: the inverse of `split`.

    They have length 1, unless the others are too long for it: the largest component is then 0.

    Args:
        place: (N,) integers from 0 to 3.
        others: (N, 3), in their order.
    """
    is_largest = np.arange(4) == place[:, None]
    result = np.empty(is_largest.shape)
    result[is_largest] = np.sqrt((1 - (others**2).sum(-1)).clip(0))
    result[~is_largest] = others.reshape(-1)
    return result
