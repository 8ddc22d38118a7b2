"""Groups of Gaussians as a camera sees them: whether it may show them, and the errors of merged ones on the image."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras
from nerfloom.kernels.splats.project import MARGIN, MIN_ALPHA, SplatCamera
from nerfloom.levels.nodes import Boxes, Nodes

STRETCH = math.pi / 2
"""Maximum ratio of a Gaussian's linearly approximated extent on an image to its true extent; fisheyes have the
largest."""
EDGE_POINTS = 33
"""Number of positions along each edge of an image, for the directions that it shows."""
SPARE = 0.02
"""Relative enlargement of the range of directions, since a lens bends edges between these positions."""
MIN_DEPTH = 1e-3
"""Minimum depth of a unit direction, because tangents are infinite at 90 degrees from the optical axis."""


def tangents(camera: Cameras, blur: float) -> Tensor:
    """Return the range (2, 2) float64 of directions that an image shows: minimum and maximum of x / z and y / z.

    Args:
        camera: one camera, of a model that Gaussians can be drawn with; x is to the right, y down and z forward.
        blur: variance that is added to Gaussians on the image, pixels^2. The range is widened
            accordingly, because Gaussians reach over the image's edges.
    """
    height, width = camera.sizes[0]
    border = math.sqrt(-2 * math.log(MIN_ALPHA) * blur)
    along = torch.linspace(0, 1, EDGE_POINTS, device=camera.fx.device)
    columns = -0.5 - border + (width + 2 * border) * along
    rows = -0.5 - border + (height + 2 * border) * along
    x = torch.cat([columns, columns, columns[:1].expand_as(rows), columns[-1:].expand_as(rows)])
    y = torch.cat([rows[:1].expand_as(columns), rows[-1:].expand_as(columns), rows, rows])
    directions = camera.look(torch.zeros_like(x, dtype=torch.int64), x, y)[2].directions.cpu().double()
    across = directions[:, :2] * torch.tensor([1.0, -1.0], dtype=torch.float64)
    across = across / (-directions[:, 2:]).clamp(min=MIN_DEPTH)
    low, high = across.amin(0), across.amax(0)
    return torch.stack([low - SPARE * (high - low), high + SPARE * (high - low)])


def reaches(logits: Tensor, log_scales: Tensor) -> Tensor:
    """Return how far (N,) float64 from their centres Gaussians of `logits` (N,) and `log_scales` (N, 3) are drawn."""
    opacities = torch.sigmoid(logits.double())
    sizes = log_scales.double().amax(1).exp()
    return (2 * (opacities / MIN_ALPHA).clamp(min=1).log()).sqrt() * sizes


def in_view(boxes: Boxes, camera: SplatCamera, tangents: Tensor) -> Tensor:
    """Return (M,) bool, whether an image may show a Gaussian of a group.

    An image of directions all around may show any.

    Args:
        boxes: boxes of M groups.
        camera: the camera in the frame of the boxes.
        tangents: (2, 2) range of its directions, from `tangents`.
    """
    if camera.all_around:
        return torch.ones(len(boxes.low), dtype=torch.bool)
    pose = camera.pose.cpu().double()
    corner = torch.cartesian_prod(*[torch.tensor([False, True])] * 3)
    corners = torch.where(corner, boxes.high[:, None], boxes.low[:, None])  # (M, 8, 3)
    x, y, depth = (corners @ pose[:, :3].T + pose[:, 3]).unbind(-1)
    seen = depth.amax(1) > 0
    low, high = tangents
    for axis, at in enumerate((x, y)):
        for side, limit in ((-1, low[axis]), (1, high[axis])):
            # Where the linear approximation of the projection is evaluated for Gaussians outside of the image.
            outermost = limit.abs() + MARGIN * (high - low)[axis]
            beyond = (side * (at - limit * depth)).amin(1)
            seen &= beyond <= STRETCH * (1 + outermost.square()).sqrt() * boxes.reach
    return seen


def sizes_on_image(nodes: Nodes, camera: SplatCamera, nearest: float) -> Tensor:
    """Return the error (M,) of each node in the middle of an image, float64, pixels.

    This is the largest standard deviation of its merged Gaussians, projected at the distance of the node's box.

    Args:
        nodes: M nodes.
        camera: the camera in the frame of the nodes.
        nearest: lower limit of the distance, in the unit of the nodes.
    """
    pose = camera.pose.cpu().double()
    position = -pose[:, :3].T @ pose[:, 3]
    gap = (nodes.low - position).clamp(min=0) + (position - nodes.high).clamp(min=0)
    return max(camera.intrinsics[:2]) * nodes.errors / gap.norm(dim=-1).clamp(min=nearest)
