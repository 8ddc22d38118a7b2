"""Numbers in files from elsewhere."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from nerfloom.base.errors import DataError

UNUSABLE = (KeyError, TypeError, ValueError, OverflowError)
"""Errors raised if a number in a file is missing or is something else."""
LARGEST = 1e30
"""Maximum magnitude of `bounded` numbers, so that their products are finite."""
MAX_SIDE = 10**9
"""Maximum width or height that a file may state, pixels."""
MAX_ROUNDING = 0.02
"""Maximum deviation of R R^T from the identity that counts as rounding."""


def finite(value: Any) -> float:
    """Convert the value `value` of a file to a number.

    Raises:
        TypeError, ValueError, OverflowError: if it is not a finite number (`UNUSABLE`).
    """
    number = float(value)
    if not math.isfinite(number):
        raise ValueError(f"{number} is not finite")
    return number


def bounded(value: Any) -> float:
    """Convert the value `value` of a file to a number of a magnitude up to `LARGEST`.

    Raises:
        TypeError, ValueError, OverflowError: if it is not such a number (`UNUSABLE`).
    """
    number = finite(value)
    if abs(number) > LARGEST:
        raise ValueError(f"{number} is out of range")
    return number


def side(value: Any) -> int:
    """Convert the value `value` of a file to the width or height of an image, from 1 to `MAX_SIDE` pixels.

    Raises:
        TypeError, ValueError, OverflowError: if it is not such a number (`UNUSABLE`).
    """
    length = int(finite(value))
    if not 1 <= length <= MAX_SIDE:
        raise ValueError(f"{length} is out of range")
    return length


def finite_array(values: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Convert values of a file to an array of numbers of a magnitude up to `LARGEST`.

    Args:
        values: numbers, or texts of numbers, nested or not.
        shape: shape of the result; its product is the number of values.
        what: name of the values in messages, with their file.

    Returns:
        Array of this shape, float64.

    Raises:
        DataError: if there are more or fewer values, or one is not such a number.
    """
    try:
        array = np.array(values, np.float64)
    except UNUSABLE as error:
        raise DataError(f"{what} must be {math.prod(shape)} numbers") from error
    if array.size != math.prod(shape) or not (np.abs(array) <= LARGEST).all():
        raise DataError(f"{what} must be {math.prod(shape)} finite numbers")
    return array.reshape(shape)


def nearest_rotation(matrix: np.ndarray, what: str) -> np.ndarray:
    """Return the rotation (3, 3) nearest to a rounded one: U V^T of the singular values U S V^T (Higham 1989).

    Args:
        matrix: (3, 3) from `finite_array`.
        what: name of the matrix in messages, with its file.

    Raises:
        DataError: if it is not a rotation up to rounding.
    """
    deviation = np.abs(matrix @ matrix.T - np.eye(3)).max()
    if not deviation <= MAX_ROUNDING or np.linalg.det(matrix) <= 0:
        raise DataError(f"{what} is not a rotation")
    left, _, right = np.linalg.svd(matrix)
    return left @ right
