"""Poses that were found beside poses that are given: the similarity between their frames, and the errors left."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from framework.base.errors import DataError


def align(estimated: Tensor, given: Tensor) -> tuple[float, Tensor, Tensor]:
    """The similarity that takes points closest to others, by the sum of squared distances.

    Umeyama 1991, "Least-squares estimation of transformation parameters between two point patterns".

    Args:
        estimated, given: (M, 3), M >= 3, in corresponding order.
    Returns: scale, rotation (3, 3) and translation (3,), float64, such that given = scale * rotation @ estimated +
        translation; the rotation is proper, and the scale never negative.
    Raises: DataError for points that lie on a line, or that are too few: the rotation is not determined then.
    """
    if estimated.shape != given.shape or estimated.ndim != 2 or estimated.shape[-1] != 3 or len(given) < 3:
        raise DataError(
            f"an alignment needs the same three or more points twice, not {len(estimated)} and {len(given)}"
        )
    source, target = estimated.double(), given.double()
    source_mean, target_mean = source.mean(0), target.mean(0)
    source, target = source - source_mean, target - target_mean
    for points in (source, target):
        spread = torch.linalg.svdvals(points)
        if not bool(spread[1] > 1e-9 * spread[0]):
            raise DataError("an alignment needs points that do not lie on a line")
    u, singular, vh = torch.linalg.svd(target.T @ source / len(source))
    signs = torch.ones(3, dtype=torch.float64)
    if bool(torch.linalg.det(u) * torch.linalg.det(vh) < 0):  # else it would be a reflection
        signs[2] = -1
    rotation = u @ torch.diag(signs) @ vh
    scale = float((singular * signs).sum() / source.square().sum(1).mean())
    return scale, rotation, target_mean - scale * (rotation @ source_mean)


def align_cameras(estimated: Tensor, given: Tensor) -> tuple[float, Tensor, Tensor]:
    """The similarity that takes cameras to others: the mean turn between them, then scale and move of their centres.

    Orientations tell the rotation better than centres whose errors are large beside their spread, and also where all
    centres lie on a line.

    Args:
        estimated, given: (M, 3, 4) camera-to-world, M >= 1, in corresponding order.
    Returns: as `align`; the scale is 1 where all centres are one point.
    """
    source, target = estimated.double(), given.double()
    u, _, vh = torch.linalg.svd((target[:, :, :3] @ source[:, :, :3].transpose(1, 2)).mean(0))
    rotation = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.linalg.det(u @ vh))]).double()) @ vh
    turned, centres = source[:, :, 3] @ rotation.T, target[:, :, 3]
    middle, centre = turned.mean(0), centres.mean(0)
    spread = float((turned - middle).square().sum())
    apart = spread > 1e-20 * float(turned.square().sum())  # more than rounding
    scale = float(((turned - middle) * (centres - centre)).sum()) / spread if apart else 1.0
    return scale, rotation, centre - scale * middle


@dataclass(frozen=True)
class PoseErrors:
    """How far M poses are from given ones after the best similarity."""

    angles: Tensor
    """(M,) degrees between the cameras' orientations."""
    distances: Tensor
    """(M,) between the cameras' centres, relative to the largest distance between two given centres."""

    @property
    def median_angle(self) -> float:
        """Degrees; the mean of the middle two of an even number."""
        return float(self.angles.quantile(0.5))

    @property
    def median_distance(self) -> float:
        """Relative to the extent of the given centres."""
        return float(self.distances.quantile(0.5))


def pose_errors(estimated: Tensor, given: Tensor) -> PoseErrors:
    """Compare camera-to-world poses (M, 3 or 4, 4) whose frames differ by an unknown similarity."""
    found, truth = estimated[:, :3].double(), given[:, :3].double()
    scale, rotation, translation = align(found[:, :, 3], truth[:, :, 3])
    centres = scale * (found[:, :, 3] @ rotation.T) + translation
    extent = torch.cdist(truth[:, :, 3], truth[:, :, 3]).max()
    turned = (rotation @ found[:, :, :3]).transpose(1, 2) @ truth[:, :, :3]
    # The angle from both sine and cosine: from the cosine alone small ones would be lost in rounding.
    skew = turned - turned.transpose(1, 2)
    sine = torch.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], dim=-1).norm(dim=-1) / 2
    cosine = (turned.diagonal(dim1=1, dim2=2).sum(-1) - 1) / 2
    angles = torch.rad2deg(torch.atan2(sine, cosine))
    return PoseErrors(angles, (centres - truth[:, :, 3]).norm(dim=-1) / extent)
