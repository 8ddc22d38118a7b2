"""Check for cameras at a single position, which show no distances."""

from __future__ import annotations

import torch
from torch import Tensor

MIN_PARALLAX = 0.01
"""There is no parallax if cameras are closer to their centre than this fraction of the distance of points."""
ROUNDING = 1e-10
"""Camera distances below this fraction of the largest coordinate are rounding: 0.5 mm at 5,000 km."""


def camera_spread(poses: Tensor, points: Tensor | None) -> float | None:
    """Return the distance between cameras, as a fraction of the distance of the scene.

    Args:
        poses: (M, 3 or 4, 4) camera-to-world.
        points: (K, 3) points on surfaces in the same frame; None if there are none.

    Returns:
        Root-mean-square distance of the cameras from their centre, over the median distance of points from it. 0 if all
        cameras stand at one position; None for a single camera, or for several positions without points.
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
    """Return a warning about cameras with too little `spread`."""
    where = "in one position" if spread == 0 else f"within {spread:.2%} of the distance of the scene"
    return (
        f"warning: all cameras stand {where}, as if one had turned on the spot: distances are unknown, and "
        "views from elsewhere will be wrong; take photographs from different positions"
    )
