"""Sparse depth: pixels with a known distance, from the points of a reconstruction (DS-NeRF, Deng et al. 2022)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras
from nerfloom.data.tracks import Sightings
from nerfloom.geometry.records import TensorRows


@dataclass(frozen=True)
class SparseDepth(TensorRows):
    """K pixels in ascending order, each with a distance."""

    pixels: Tensor
    """(K,) int64 numbers of the pixels, counted over all images."""
    distances: Tensor
    """(K,) distance along the ray of the pixel's centre, scene units."""
    deviations: Tensor
    """(K,) standard deviation of the distance, scene units."""

    def __len__(self) -> int:
        return len(self.pixels)


@torch.no_grad()
def sparse_depth(sightings: Sightings, cameras: Cameras) -> SparseDepth:
    """Return the pixels where images see sparse points, from the points' projections, lens included.

    If a pixel shows several points, the one with the best-known distance is used. A point's distance along the ray of
    its pixel's centre is the distance of the nearest position on the ray.

    Args:
        sightings: points seen in the cameras' images; points outside an image or behind its camera are left out.
        cameras: M cameras, for the decoded images.
    """
    images = sightings.images
    columns, rows, ahead = cameras.project(sightings.points, images)
    # The centre of pixel (c, r) projects to (c, r), so rounding gives the pixel.
    columns, rows = columns.round(), rows.round()
    widths, heights = cameras.widths[images], cameras.heights[images]
    inside = ahead & (columns >= 0) & (columns < widths) & (rows >= 0) & (rows < heights)
    images, points, deviations = (values[inside] for values in (images, sightings.points, sightings.deviations))
    columns, rows = columns[inside].long(), rows[inside].long()
    pixels = cameras.offsets[images] + rows * cameras.widths[images] + columns
    rays = cameras.rays(images, columns.float(), rows.float(), 0.0, 1.0)
    distances = ((points - rays.origins) * rays.directions).sum(-1)
    order = deviations.argsort(stable=True)
    order = order[pixels[order].argsort(stable=True)]
    found = SparseDepth(pixels, distances, deviations)[order]
    first = torch.ones(len(found), dtype=torch.bool, device=pixels.device)
    first[1:] = found.pixels.diff() > 0
    return found[first & (found.distances > 0)]
