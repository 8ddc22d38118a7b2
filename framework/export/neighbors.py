"""Outliers among points, and normals of their surface, from the nearest neighbours of each point."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.console import track

NEIGHBORS = 20
"""Number of nearest neighbours."""
CHUNK = 2**16
"""Number of points in one look-up of neighbours."""


def mean_distances(points: Tensor) -> Tensor:
    """Return the mean distance (K,) of each of the finite `points` (K, 3) to its nearest neighbours."""
    means = [distances[:, 1:].mean(1) for distances, _ in _nearest(points)]
    return torch.from_numpy(np.concatenate([np.zeros(0), *means]))


def inliers(points: Tensor, std_ratio: float) -> Tensor:
    """Return the points (K,) bool with a usual mean distance to their neighbours.

    It is unusual if it exceeds the mean over all points by more than some standard deviations (Rusu et al. 2008).

    Args:
        points: (K, 3) finite positions.
        std_ratio: number of standard deviations.
    """
    if len(points) < 3:
        return torch.ones(len(points), dtype=torch.bool)
    distances = mean_distances(points)
    return distances <= distances.mean() + std_ratio * distances.std()


def plane_normals(points: Tensor, towards: Tensor) -> Tensor:
    """Return unit normals (K, 3) float32: the direction of least spread of each point's neighbours.

    Args:
        points: (K, 3) finite positions.
        towards: (K, 3) directions, for example to the camera that saw the point; normals are flipped towards them.
    """
    positions = points.double()
    found, start = [torch.zeros(0, 3, dtype=torch.float64)], 0
    for _, indices in _nearest(points):
        around = positions[torch.from_numpy(indices)]
        centred = around - around.mean(1, keepdim=True)
        normal = torch.linalg.eigh(centred.transpose(1, 2) @ centred).eigenvectors[:, :, 0]
        facing = (normal * towards[start : start + len(normal)].double()).sum(-1, keepdim=True)
        found.append(torch.where(facing < 0, -normal, normal))
        start += len(normal)
    return torch.cat(found).float()


def _nearest(points: Tensor) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield distances and indices (N, 21) of each point and its nearest neighbours, fewer of few points, by chunks."""
    from scipy.spatial import cKDTree

    values = points.double().numpy()
    tree = cKDTree(values)
    most = min(NEIGHBORS + 1, len(values))
    for start in track(starts := range(0, len(values), CHUNK), "Looking for neighbours", total=len(starts)):
        distances, indices = tree.query(values[start : start + CHUNK], k=most, workers=-1)
        yield distances.reshape(-1, most), indices.reshape(-1, most)
