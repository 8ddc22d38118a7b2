"""Cameras that stand in one position: nothing then tells how far anything is."""

from __future__ import annotations

import torch
from torch import Tensor

SMALL = 0.01
"""Distance of cameras from their middle, as a share of the distance of points, below which there is no parallax."""
ROUNDING = 1e-10
"""The same as a share of the largest coordinate, below which it is rounding: half a millimetre of 5,000 kilometres."""


def camera_spread(poses: Tensor, points: Tensor | None) -> float | None:
    """Return how far cameras are apart, as a share of the distance of what they see.

    Args:
        poses: (M, 3 or 4, 4) camera-to-world.
        points: (K, 3) points on surfaces in the same frame; None if there are none.

    Returns:
        Root mean square distance of the cameras from their middle by the median distance of points from it: 0 if all
        cameras stand in one position, None if there are several positions and no points, or a single camera.
    """
    if len(poses) < 2:
        return None
    centres = poses[:, :3, 3].double()
    middle = centres.mean(0)
    spread = float((centres - middle).square().sum(-1).mean().sqrt())
    if spread <= ROUNDING * float(centres.abs().max()):
        return 0.0
    if points is None or len(points) == 0:
        return None
    return spread / max(float(torch.linalg.norm(points.double() - middle, dim=-1).median()), 1e-12)


def warning(spread: float) -> str:
    """Return a line of text that warns of cameras with too little `spread`."""
    where = "in one position" if spread == 0 else f"within {spread:.2%} of the distance of what they see"
    return (
        f"warning: all cameras stand {where}, as if one had turned on the spot: nothing tells how far anything is, and "
        "views from elsewhere will be wrong; take photographs from different positions"
    )
