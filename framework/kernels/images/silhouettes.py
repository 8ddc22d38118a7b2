"""Projections of balls into an image with alpha, for the visual hull (Laurentini 1994).

They determine which balls the image shows to be empty, and which pixels may show the others; see
`nerfloom.scene.silhouettes`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from nerfloom.kernels import native
from nerfloom.kernels.dispatch import BOOL, CPP, Operation

_sums = native.Function("opaque_sums", "pqqp")
_hold = native.Function("hold_balls", "pqfpffffpqqiipi")
_near = native.Function("pixels_near_balls", "pqfpffffpqqipi")


@dataclass(frozen=True)
class Photograph:
    """An image with alpha, taken by a pinhole camera."""

    pose: Tensor
    """(3, 4) camera-to-world matrix."""
    fx: float
    """Focal length along x, pixels."""
    fy: float
    """Focal length along y, pixels."""
    cx: float
    """Principal point along x, pixels."""
    cy: float
    """Principal point along y, pixels."""
    sums: Tensor
    """(H + 1, W + 1) int32 sums of the pixels that are not fully transparent (`opaque_sums`)."""
    closed: bool = False
    """Whether space outside the frame is empty, as if the image continued, transparent, on all sides."""

    @property
    def height(self) -> int:
        """Height H in pixels."""
        return self.sums.shape[0] - 1

    @property
    def width(self) -> int:
        """Width W in pixels."""
        return self.sums.shape[1] - 1

    def depth(self, points: Tensor) -> Tensor:
        """Return the depth (N,) of `points` (N, 3) along the optical axis, scene units."""
        return (self.pose[:, 3] - points) @ self.pose[:, 2]  # the camera looks along its -z axis

    def arguments(self, centers: Tensor, radius: float) -> tuple[Any, ...]:
        """Return the first arguments of the kernels, for balls of `radius` around `centers` (N, 3), contiguous."""
        return (
            native.pointer(centers, "the centres", (len(centers), 3)), len(centers), radius,
            native.pointer(self.pose, "the pose", (3, 4)), self.fx, self.fy, self.cx, self.cy,
            native.pointer(self.sums, "the sums", (self.height + 1, self.width + 1), torch.int32),
            self.height, self.width, int(self.closed),
        )  # fmt: skip


def opaque_sums_reference(opaque: Tensor) -> Tensor:
    """Compute `opaque_sums` of `opaque` in PyTorch, on any device."""
    sums = opaque.to(torch.int32).cumsum(0, dtype=torch.int32).cumsum(1, dtype=torch.int32)
    return functional.pad(sums, (1, 0, 1, 0))


def opaque_sums(opaque: Tensor) -> Tensor:
    """Return the number (H + 1, W + 1) int32 of pixels of `opaque` (H, W) bool above and left of each pixel corner."""
    return OPAQUE_SUMS((opaque,), opaque)


OPAQUE_SUMS = Operation("opaque_sums", opaque_sums_reference)


@OPAQUE_SUMS.implementation(CPP, types=BOOL)
def _opaque_sums(opaque: Tensor) -> Tensor:
    height, width = opaque.shape
    sums = torch.empty(height + 1, width + 1, dtype=torch.int32)
    opaque = opaque.contiguous()
    _sums(native.pointer(opaque, "opaque", (height, width), torch.bool), height, width, sums.data_ptr())
    return sums


def footprint(photograph: Photograph, centers: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Return the bounding rectangles of projected balls, one pixel larger on each side.

    Args:
        photograph: the image.
        centers: (N, 3) centres of the balls, scene coordinates.
        radius: radius of the balls, scene units.

    Returns:
        Left, right, top and bottom (4, N) int64 as numbers of pixel corners, clamped to the image; and (N,) bool, True
        for balls in front of the camera with a rectangle entirely inside the image, or anywhere if it is closed.
    """
    pose, depth = photograph.pose, photograph.depth(centers)
    nearest = depth - radius
    safe = nearest.clamp(min=1e-6)
    local = (centers - pose[:, 3]) @ pose[:, :2]
    column = photograph.cx + photograph.fx * local[:, 0] / depth
    row = photograph.cy - photograph.fy * local[:, 1] / depth
    # Off the optical axis, the image of a ball is an ellipse, longer than wide by a factor of at most 1 / cos^2.
    slant = 1 + (local / safe[:, None]).square().sum(-1)
    reach = radius / safe * max(photograph.fx, photograph.fy) * slant + 1  # edges are accurate to a pixel
    edges = torch.stack(
        [(column - reach).floor(), (column + reach).ceil(), (row - reach).floor(), (row + reach).ceil()]
    )
    height, width = photograph.height, photograph.width
    limits = torch.tensor([[width], [width], [height], [height]], device=edges.device)
    inside = (edges >= 0).all(0) & (edges <= limits).all(0)
    whole = (nearest > 0) & (inside | photograph.closed)
    return torch.minimum(edges.nan_to_num().clamp(min=0), limits).long(), whole


def _may_hold(photograph: Photograph, centers: Tensor, radius: float, every: bool) -> Tensor:
    (x0, x1, y0, y1), whole = footprint(photograph, centers, radius)
    flat, stride = photograph.sums.view(-1), photograph.width + 1
    count = flat[y1 * stride + x1] - flat[y1 * stride + x0] - flat[y0 * stride + x1] + flat[y0 * stride + x0]
    if every:
        return ~whole | (count > 0)
    depth = photograph.depth(centers)
    return torch.where(depth > radius, count > 0, ~(depth <= -radius))


def hold_balls_reference(photograph: Photograph, centers: Tensor, radius: float, held: Tensor, every: bool) -> None:
    """Compute `hold_balls` of `photograph`, `centers`, `radius`, `held` and `every` in PyTorch, on any device."""
    rest = (held if every else ~held).nonzero().squeeze(-1)
    held[rest] = _may_hold(photograph, centers[rest], radius, every)


def hold_balls(photograph: Photograph, centers: Tensor, radius: float, held: Tensor, every: bool) -> None:
    """Update, in place, which balls may hold matter, using one image.

    An image shows a ball to be empty if the ball's `footprint` has no opaque pixel and is entirely inside the image, or
    anywhere in front of the camera if the image is closed. It shows matter in a ball's direction if the part of the
    footprint inside the image has an opaque pixel.

    Args:
        photograph: the image.
        centers: (N, 3) centres of the balls, scene coordinates.
        radius: radius of the balls, scene units.
        held: (N,) bool, the result of the previous images.
        every: True for balls that no image shows to be empty; `held` starts as True. False for balls with matter in
            their direction in at least one image, and balls around a camera's plane; `held` starts as False.
    """
    HOLD_BALLS((photograph.pose, centers), photograph, centers, radius, held, every)


HOLD_BALLS = Operation("hold_balls", hold_balls_reference)


@HOLD_BALLS.implementation(CPP)
def _hold_balls(photograph: Photograph, centers: Tensor, radius: float, held: Tensor, every: bool) -> None:
    address = native.pointer(held, "held", (len(centers),), torch.bool)
    _hold(*photograph.arguments(centers, radius), int(every), address, native.threads())


def pixels_near_balls_reference(photograph: Photograph, centers: Tensor, radius: float) -> Tensor:
    """Compute `pixels_near_balls` of `photograph`, `centers` and `radius` in PyTorch, on any device."""
    return _near_opaque(photograph, centers, radius) | _under_cut_balls(photograph, centers, radius)


def pixels_near_balls(photograph: Photograph, centers: Tensor, radius: float) -> Tensor:
    """Return the pixels (H, W) bool with rays that may meet one of the balls, with a margin.

    The projection of a ball that is entirely inside the image contains an opaque pixel, and the pixels of rays that
    meet the ball. So all pixels within twice the largest radius of a projection around opaque pixels suffice. For balls
    partly outside the image, all pixels of their rectangles are included.

    Args:
        photograph: the image.
        centers: (N, 3) centres of balls that no image shows to be empty, scene coordinates.
        radius: radius of the balls, scene units.
    """
    return PIXELS_NEAR_BALLS((photograph.pose, centers), photograph, centers, radius)


PIXELS_NEAR_BALLS = Operation("pixels_near_balls", pixels_near_balls_reference)


@PIXELS_NEAR_BALLS.implementation(CPP)
def _pixels_near_balls(photograph: Photograph, centers: Tensor, radius: float) -> Tensor:
    near = torch.empty(photograph.height, photograph.width, dtype=torch.bool)
    _near(*photograph.arguments(centers, radius), near.data_ptr(), native.threads())
    return near


def _near_opaque(photograph: Photograph, centers: Tensor, radius: float) -> Tensor:
    sums, height, width = photograph.sums, photograph.height, photograph.width
    focal = max(photograph.fx, photograph.fy)
    nearest = float(photograph.depth(centers).min()) - radius if len(centers) else 1.0
    slant = 1 + ((width / 2) ** 2 + (height / 2) ** 2) / focal**2
    reach = int(2 * radius / nearest * focal * slant) + 5 if nearest > 0 else max(height, width)
    rows, columns = (torch.arange(n, device=sums.device) for n in (height, width))
    top, bottom = (rows - reach).clamp(min=0), (rows + reach + 1).clamp(max=height)
    left, right = (columns - reach).clamp(min=0), (columns + reach + 1).clamp(max=width)
    band = sums[bottom] - sums[top]
    return band[:, right] - band[:, left] > 0


def _under_cut_balls(photograph: Photograph, centers: Tensor, radius: float) -> Tensor:
    (x0, x1, y0, y1), whole = footprint(photograph, centers, radius)
    depth = photograph.depth(centers)
    cut = ~whole & (x1 > x0) & (y1 > y0) & (depth > -radius)
    if bool((cut & (depth <= radius)).any()):  # the camera may be inside the ball
        return torch.ones(photograph.height, photograph.width, dtype=torch.bool, device=centers.device)
    return _covered(photograph, x0, x1, y0, y1, cut)


def pixels_under_balls(photograph: Photograph, centers: Tensor, radius: float) -> Tensor:
    """Return the pixels (H, W) bool in the `footprint` of a ball, on any device, with a margin.

    If a ball extends through the camera's plane, these are all pixels.

    Args:
        photograph: a camera; its image is not used.
        centers: (N, 3) centres of the balls, scene coordinates.
        radius: radius of the balls, scene units.
    """
    (x0, x1, y0, y1), _ = footprint(photograph, centers, radius)
    depth = photograph.depth(centers)
    if not bool((depth.abs() > radius).all()):
        return torch.ones(photograph.height, photograph.width, dtype=torch.bool, device=centers.device)
    return _covered(photograph, x0, x1, y0, y1, depth > 0)


def _covered(photograph: Photograph, x0: Tensor, x1: Tensor, y0: Tensor, y1: Tensor, chosen: Tensor) -> Tensor:
    """Return the pixels (H, W) bool in any of the rectangles (N,) that are `chosen` (N,)."""
    height, width = photograph.height, photograph.width
    marks = torch.zeros((height + 1) * (width + 1), dtype=torch.int32, device=chosen.device)
    for x, y, sign in ((x0, y0, 1), (x1, y0, -1), (x0, y1, -1), (x1, y1, 1)):
        marks.index_add_(0, y * (width + 1) + x, chosen.to(torch.int32) * sign)
    count = marks.view(height + 1, width + 1).cumsum(0).cumsum(1)
    return count[:height, :width] > 0
