"""Rigid motions from six numbers each: exponentials of the Lie groups SO(3) and SE(3).

With w the rotation vector, K its cross product matrix and a = |w| (Murray, Li and Sastry 1994, "A Mathematical
Introduction to Robotic Manipulation", section 2.2 and proposition 2.9):

    exp(K) = I + sin(a) / a K + (1 - cos(a)) / a^2 K^2
    exp([K, u; 0, 0]) = [exp(K), V u; 0, 1],   V = I + (1 - cos(a)) / a^2 K + (a - sin(a)) / a^3 K^2
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from nerfloom.kernels.dispatch import TORCH, Operation
from nerfloom.kernels.math import cross_matrix

MAX_SERIES_ANGLE = 0.25
"""Below this squared angle the factors are computed as series, which neither divide by 0 nor cancel."""


def rigid_motions_reference(tangents: Tensor, screw: bool) -> Tensor:
    """Compute `rigid_motions` of `tangents` and `screw` by PyTorch's matrix exponential, which waits for the device."""
    translation, rotation = tangents[:, :3], tangents[:, 3:]
    generator = torch.cat([cross_matrix(rotation), translation[:, :, None]], dim=-1)
    if screw:
        return torch.linalg.matrix_exp(nn.functional.pad(generator, (0, 0, 0, 1)))[:, :3]
    # The matrix exponential has a value and a gradient at zero, where Rodrigues' formula is 0 / 0.
    return torch.cat([torch.linalg.matrix_exp(generator[:, :, :3]), translation[:, :, None]], dim=-1)


def rigid_motions(tangents: Tensor, screw: bool) -> Tensor:
    """Return rigid motions, with first and higher derivatives.

    Args:
        tangents: (M, 6) translations, and rotation vectors in radians.
        screw: whether a motion is one screw about the origin, the exponential of SE(3). Otherwise only the rotation is
            an exponential, of SO(3), and the translation is used unchanged.

    Returns:
        (M, 3, 4) rotations and translations.
    """
    return RIGID_MOTIONS((tangents,), tangents, screw)


RIGID_MOTIONS = Operation("rigid_motions", rigid_motions_reference)


@RIGID_MOTIONS.implementation(TORCH, types=None, order=torch.inf)
def _closed_form(tangents: Tensor, screw: bool) -> Tensor:
    """Compute `rigid_motions` in closed form, which is faster and does not wait for the device."""
    translation, rotation = tangents[:, :3], tangents[:, 3:]
    squared = rotation.square().sum(-1)[:, None, None]
    small = squared < MAX_SERIES_ANGLE
    # Each form gets valid arguments, so that the unused one has a finite gradient.
    near, angle = torch.where(small, squared, 0), torch.where(small, 1, squared).sqrt()
    first = torch.where(small, _series(near, 1), angle.sin() / angle)
    second = torch.where(small, _series(near, 2), 2 * ((angle / 2).sin() / angle).square())
    cross = cross_matrix(rotation)
    # Products and sums, because autocast would round a matrix product to bfloat16.
    twice = (cross[:, :, :, None] * cross[:, None]).sum(2)
    identity = torch.eye(3, dtype=tangents.dtype, device=tangents.device)
    rotations = identity + first * cross + second * twice
    if screw:
        third = torch.where(small, _series(near, 3), (angle - angle.sin()) / angle**3)
        translation = ((identity + second * cross + third * twice) * translation[:, None]).sum(-1)
    return torch.cat([rotations, translation[:, :, None]], dim=-1)


def _series(squared: Tensor, first: int) -> Tensor:
    """Return 1 / k! - a^2 / (k + 2)! + a^4 / (k + 4)! - ..., from a squared angle, for k = `first`."""
    total = torch.ones_like(squared)
    for last in range(first + 12, first, -2):
        total = 1 - squared / (last * (last - 1)) * total
    return total / math.factorial(first)
