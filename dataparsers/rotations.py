"""Rotations in files: matrices and quaternions rounded when written.

Rounded rotations are corrected silently. Anything else stays unchanged, to be refused later.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from nerfloom import DataError
from nerfloom.kernels.math import cross_matrix

MAX_ROUNDING = 0.02
"""Maximum deviation of R R^T from the identity, and of a quaternion's length from 1, that counts as rounding, as of
numbers with two decimals."""
EXACT_TOLERANCE = 1e-12
"""A matrix with a smaller deviation is left unchanged."""


def nearest_rotation(matrix: Tensor) -> Tensor:
    """Return the rotation (3, 3) nearest to a rounded rotation matrix; any other matrix is returned unchanged.

    It is U V^T of the singular value decomposition U S V^T (Higham 1989).

    Args:
        matrix: (3, 3) float64.
    """
    deviation = float((matrix @ matrix.T - torch.eye(3, dtype=matrix.dtype)).abs().max())
    if not EXACT_TOLERANCE < deviation <= MAX_ROUNDING:  # NaN is unchanged too
        return matrix
    left, _, right = torch.linalg.svd(matrix)
    return left @ right


def unit_quaternions(quaternions: Tensor, labels: Sequence[str]) -> Tensor:
    """Return `quaternions` (M, 4) float64 with length 1; `labels` are their names for messages.

    Raises:
        DataError: if a length is not 1 up to rounding.
    """
    norms = quaternions.norm(dim=-1)
    deviation = (norms - 1).abs().nan_to_num(torch.inf)
    if bool((deviation > MAX_ROUNDING).any()):
        index = int(deviation.argmax())
        raise DataError(f"{labels[index]} has a quaternion of length {norms[index]:.3g}; a rotation's is 1")
    return quaternions / norms[:, None]


def rotations(quaternions: Tensor) -> Tensor:
    """Return the rotation matrices (M, 3, 3) of unit `quaternions` (M, 4) x, y, z, w."""
    vector, scalar = quaternions[:, :3], quaternions[:, 3]
    cross = cross_matrix(vector)
    # Rodrigues' formula with half angles: v -> v + 2 w (u x v) + 2 u x (u x v).
    return torch.eye(3, dtype=quaternions.dtype) + 2 * (scalar[:, None, None] * cross + cross @ cross)
