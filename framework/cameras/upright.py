"""Up direction of photographs that lie on their side, as a phone held upright stores them."""

from __future__ import annotations

import torch
from torch import Tensor

MIN_TURN = 0.15
"""Minimum difference of second moments of the column axes, in their plane minus across it, as of an 80 degree arc."""
MIN_CLARITY_RATIO = 2.0
"""Minimum clarity of the plane of the column axes, relative to the clarity of the plane of the row axes."""
MIN_WIDTH = 0.25
"""Minimum spread of the camera positions along their second principal direction, relative to the first."""
MIN_DOWNWARD = 0.1
"""Minimum mean sine of the downward angle; below it, the viewing direction does not tell up from down."""


def sideways_up(poses: Tensor) -> Tensor | None:
    """Return the up direction of photographs that lie on their side; None if they stand upright or it is unclear.

    A camera that moves around an object turns about the vertical axis. The horizontal image axis then stays in one
    plane, however high or low the camera looks. This is the row axis (x) of upright images, and the column axis
    (y) of images that lie on their side. The result is None unless the plane of y is twice as clear as the plane of x,
    and the cameras stand around something. For cameras in a line, looking up and down turns y in a plane too.

    Up is the normal of this plane, on the side that makes the cameras look down. If they look neither up nor down, up
    is the left of the image, as in a phone's photographs stored in sensor orientation.

    Args:
        poses: (M, 3 or 4, 4) camera-to-world, OpenGL axes, of images that were all held the same way.

    Returns:
        (3,) float64 unit vector in the frame of the poses; None as above.
    """
    precise = poses[:, :3].double().cpu()
    if len(precise) < 3 or not bool(precise.isfinite().all()):
        return None
    right, up, ahead, positions = precise[:, :, 0], precise[:, :, 1], -precise[:, :, 2], precise[:, :, 3]
    (_, in_upright), (normal, in_sideways) = _plane(right), _plane(up)
    widths = torch.linalg.svdvals(positions - positions.mean(0))
    around = bool(widths[1] > MIN_WIDTH * widths[0])
    if in_sideways < MIN_TURN or in_sideways < MIN_CLARITY_RATIO * in_upright or not around:
        return None
    down = float(ahead.mean(0) @ normal)
    towards = down if abs(down) > MIN_DOWNWARD else float(right.mean(0) @ normal)
    return -normal if towards > 0 else normal


def _plane(axes: Tensor) -> tuple[Tensor, float]:
    """Return the normal of the plane that best fits directions (M, 3), and how clearly they lie in it, 0 to 1/2.

    The clarity is the smaller second moment in the plane minus the one across it.
    """
    moments, directions = torch.linalg.eigh(axes.T @ axes / len(axes))
    return directions[:, 0], float(moments[1] - moments[0])
