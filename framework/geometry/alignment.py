"""The similarity between two frames, from points or cameras that are known in both."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.base.errors import DataError


def align(estimated: Tensor, given: Tensor) -> tuple[float, Tensor, Tensor]:
    """Return the least-squares similarity transform from one set of points to another.

    Umeyama 1991, "Least-squares estimation of transformation parameters between two point patterns".

    Args:
        estimated: (M, 3) points to be transformed, M >= 3.
        given: (M, 3) points to be matched, in the same order.

    Returns:
        scale, rotation (3, 3) and translation (3,), float64, with given = scale * rotation @ estimated + translation.
        The rotation is proper, and the scale is not negative.

    Raises:
        DataError: if there are fewer than three points, or they lie on a line, so that the rotation is not determined.
    """
    if estimated.shape != given.shape or estimated.ndim != 2 or estimated.shape[-1] != 3 or len(given) < 3:
        raise DataError(
            f"an alignment needs three or more pairs of points, not {len(estimated)} and {len(given)} points"
        )
    source, target = estimated.double(), given.double()
    source_mean, target_mean = source.mean(0), target.mean(0)
    source, target = source - source_mean, target - target_mean
    for points in (source, target):
        spread = torch.linalg.svdvals(points)
        if not bool(spread[1] > 1e-9 * spread[0]):
            raise DataError("an alignment needs points that do not all lie on a line")
    u, singular, vh = torch.linalg.svd(target.T @ source / len(source))
    signs = torch.ones(3, dtype=torch.float64)
    if bool(torch.linalg.det(u) * torch.linalg.det(vh) < 0):  # otherwise the result would be a reflection
        signs[2] = -1
    rotation = u @ torch.diag(signs) @ vh
    scale = float((singular * signs).sum() / source.square().sum(1).mean())
    return scale, rotation, target_mean - scale * (rotation @ source_mean)


def align_cameras(estimated: Tensor, given: Tensor) -> tuple[float, Tensor, Tensor]:
    """Return the similarity transform from one set of cameras to another, with the mean relative rotation.

    Orientations determine the rotation better than centres do if the errors of the centres are large compared with
    their spread, or all centres lie on a line.

    Args:
        estimated: (M, 3, 4) camera-to-world matrices to be transformed, M >= 1.
        given: (M, 3, 4) camera-to-world matrices to be matched, in the same order.

    Returns:
        Same as `align`. The scale is 1 if all centres coincide.
    """
    source, target = estimated.double(), given.double()
    u, _, vh = torch.linalg.svd((target[:, :, :3] @ source[:, :, :3].transpose(1, 2)).mean(0))
    rotation = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.linalg.det(u @ vh))]).double()) @ vh
    rotated, centres = source[:, :, 3] @ rotation.T, target[:, :, 3]
    source_mean, target_mean = rotated.mean(0), centres.mean(0)
    spread = float((rotated - source_mean).square().sum())
    distinct = spread > 1e-20 * float(rotated.square().sum())  # beyond rounding errors
    scale = float(((rotated - source_mean) * (centres - target_mean)).sum()) / spread if distinct else 1.0
    return scale, rotation, target_mean - scale * source_mean


def nearest_rotations(matrices: Tensor) -> Tensor:
    """Return the rotations (F, 3, 3) closest to `matrices` (F, 3, 3)."""
    u, _, vh = torch.linalg.svd(matrices)
    flips = torch.ones_like(matrices[:, 0])
    flips[:, 2] = torch.linalg.det(u @ vh)
    return (u * flips[:, None]) @ vh
