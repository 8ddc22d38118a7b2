"""Moments of the places of Gaussians along rays, in place of their colours."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.kernels.splats.project import Record
from nerfloom.splats.rasteriser import Projected


def with_moments(shown: Projected, unit: Tensor) -> Projected:
    """Return Gaussians on an image with m, m^2 and 0 in place of their colours, where m is their place along the ray.

    A place is minus a length over the distance from the camera, as is the depth of 2D Gaussian Splatting up to a
    constant. The mean over the Gaussians on the image is subtracted, so that differences of sums of m and m^2 keep
    their digits. Distances get a gradient, and the mean gets none.

    Args:
        shown: N Gaussians on the image.
        unit: () the length, scene units.
    """
    records = shown.records
    there = records[:, Record.CUT].detach() > 0
    places = -unit / torch.where(there, records[:, Record.DISTANCE], 1)
    mean = torch.where(there, places.detach(), 0).sum() / there.sum().clamp(min=1)
    m = torch.where(there, places - mean, 0)
    moments = torch.stack([m, m * m, torch.zeros_like(m)], -1)
    columns = [records[:, : Record.RED], moments, records[:, Record.DISTANCE :]]
    return shown._replace(records=torch.cat(columns, 1))
