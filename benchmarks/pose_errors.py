"""Errors of estimated poses, after the best similarity transform to the given ones."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from nerfloom.geometry.alignment import align


@dataclass(frozen=True)
class PoseErrors:
    """Differences between M estimated and given poses after the best similarity transform."""

    angles: Tensor
    """(M,) angles between the cameras' orientations, degrees."""
    distances: Tensor
    """(M,) distances between the cameras' centres, relative to the largest distance between two given centres."""

    @property
    def median_angle(self) -> float:
        """The median angle, degrees; for an even number, the mean of the middle two."""
        return float(self.angles.quantile(0.5))

    @property
    def median_distance(self) -> float:
        """The median distance, relative to the extent of the given centres."""
        return float(self.distances.quantile(0.5))


def pose_errors(estimated: Tensor, given: Tensor) -> PoseErrors:
    """Compare camera-to-world poses in frames that differ by an unknown similarity transform.

    Args:
        estimated: (M, 3 or 4, 4).
        given: (M, 3 or 4, 4) in the same order.

    Raises:
        DataError: if there are fewer than three cameras, or their centres lie on a line.
    """
    source, target = estimated[:, :3].double(), given[:, :3].double()
    scale, rotation, translation = align(source[:, :, 3], target[:, :, 3])
    centres = scale * (source[:, :, 3] @ rotation.T) + translation
    extent = torch.cdist(target[:, :, 3], target[:, :, 3]).max()
    rotated = (rotation @ source[:, :, :3]).transpose(1, 2) @ target[:, :, :3]
    # The angle is computed from sine and cosine; small angles cannot be recovered from the rounded cosine alone.
    skew = rotated - rotated.transpose(1, 2)
    sine = torch.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], dim=-1).norm(dim=-1) / 2
    cosine = (rotated.diagonal(dim1=1, dim2=2).sum(-1) - 1) / 2
    angles = torch.rad2deg(torch.atan2(sine, cosine))
    return PoseErrors(angles, (centres - target[:, :, 3]).norm(dim=-1) / extent)
