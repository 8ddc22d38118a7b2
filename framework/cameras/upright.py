"""The direction that is up in photographs that lie on their side, as a phone stores them that was held upright."""

from __future__ import annotations

import torch
from torch import Tensor

LEAST_TURN = 0.15
"""Least second moment of the axes along columns in their plane, beyond that across it: of an arc of 80 degrees."""
CLEARER = 2.0
"""How many times clearer the plane of the axes along columns must be than that of the axes along rows."""
LEAST_WIDTH = 0.25
"""Least spread of the cameras' positions in their second direction, relative to that in their first."""
LOOKING_DOWN = 0.1
"""Mean sine of the angle of looking down from which it says which side is up."""


def sideways_up(poses: Tensor) -> Tensor | None:
    """Return what is up for photographs that lie on their side; None if they stand upright, or one cannot tell.

    Whoever walks around something turns about the vertical. The horizontal axis of the images then stays in one plane,
    however high or low the camera looks: the axis along rows (x) if they stand upright, the one along columns (y) if
    they lie on their side. It counts as known only if that plane is twice as clear as that of the other axis,
    and if the cameras stand around something rather than in a line, along which to look up and down turns y alike.

    Of the two directions across the plane that one is up by which the cameras look down. If they look neither up nor
    down, it is the image's left: a phone's photographs are so when they are stored as its sensor lies.

    Args:
        poses: (M, 3 or 4, 4) camera-to-world, OpenGL axes, of images that were all held the same way.

    Returns:
        (3,) float64 of length 1, in the frame of the poses; None as above.
    """
    precise = poses[:, :3].double().cpu()
    if len(precise) < 3 or not bool(precise.isfinite().all()):
        return None
    right, up, ahead, positions = precise[:, :, 0], precise[:, :, 1], -precise[:, :, 2], precise[:, :, 3]
    (_, in_upright), (normal, in_sideways) = _plane(right), _plane(up)
    widths = torch.linalg.svdvals(positions - positions.mean(0))
    around = bool(widths[1] > LEAST_WIDTH * widths[0])
    if in_sideways < LEAST_TURN or in_sideways < CLEARER * in_upright or not around:
        return None
    down = float(ahead.mean(0) @ normal)
    towards = down if abs(down) > LOOKING_DOWN else float(right.mean(0) @ normal)
    return -normal if towards > 0 else normal


def _plane(axes: Tensor) -> tuple[Tensor, float]:
    """Return the normal of the plane that directions (M, 3) are nearest to, and how clearly they lie in it, 0 to 1/2.

    The latter is the smaller of their second moments in the plane, less that across it.
    """
    moments, directions = torch.linalg.eigh(axes.T @ axes / len(axes))
    return directions[:, 0], float(moments[1] - moments[0])
