"""Balls in space that a photograph with alpha shows to be empty, and its pixels that may see the others.

Used for the visual hull (Laurentini 1994): see `framework.scene.silhouettes`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from framework.kernels import native
from framework.kernels.dispatch import BOOL, CPP, Operation

_sums = native.Function("opaque_sums", "pqqp")
_hold = native.Function("hold_balls", "pqfpffffpqqipi")
_near = native.Function("pixels_near_balls", "pqfpffffpqqpi")


@dataclass(frozen=True)
class Photograph:
    """A photograph taken through a pinhole camera."""

    pose: Tensor
    """(3, 4) camera to world."""
    fx: float
    fy: float
    cx: float
    cy: float
    sums: Tensor
    """(H + 1, W + 1) int32 of its pixels that are not fully transparent (`opaque_sums`)."""

    @property
    def height(self) -> int:
        return self.sums.shape[0] - 1

    @property
    def width(self) -> int:
        return self.sums.shape[1] - 1

    def depth(self, points: Tensor) -> Tensor:
        """Distance (N,) of points (N, 3) along the camera's axis."""
        return (self.pose[:, 3] - points) @ self.pose[:, 2]  # the camera looks down its -z

    def arguments(self, centers: Tensor, radius: float) -> tuple[Any, ...]:
        """The kernels' first arguments. `pose` and `centers` must be contiguous."""
        return (
            native.pointer(centers, "the centres", (len(centers), 3)), len(centers), radius,
            native.pointer(self.pose, "the pose", (3, 4)), self.fx, self.fy, self.cx, self.cy,
            native.pointer(self.sums, "the sums", (self.height + 1, self.width + 1), torch.int32),
            self.height, self.width,
        )  # fmt: skip


def opaque_sums_reference(opaque: Tensor) -> Tensor:
    """As `opaque_sums`, in torch, on any device."""
    sums = opaque.to(torch.int32).cumsum(0, dtype=torch.int32).cumsum(1, dtype=torch.int32)
    return functional.pad(sums, (1, 0, 1, 0))


def opaque_sums(opaque: Tensor) -> Tensor:
    """(H + 1, W + 1) int32 from (H, W) bool: how many opaque pixels lie above and left of each pixel's corner."""
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
    """Where a photograph shows balls of `radius` around centers (N, 3), to a pixel more on each side.

    Returns: left, right, top, bottom (4, N) in pixels' corners, clamped to the photograph; and (N,) bool whether
        the ball lies in it whole, in front of the camera.
    """
    pose, depth = photograph.pose, photograph.depth(centers)
    nearest = depth - radius
    safe = nearest.clamp(min=1e-6)
    local = (centers - pose[:, 3]) @ pose[:, :2]
    column = photograph.cx + photograph.fx * local[:, 0] / depth
    row = photograph.cy - photograph.fy * local[:, 1] / depth
    # A ball at an angle to the axis is seen as an ellipse, at most 1 / cos^2 as long as its height is wide.
    slant = 1 + (local / safe[:, None]).square().sum(-1)
    reach = radius / safe * max(photograph.fx, photograph.fy) * slant + 1  # an edge is known to a pixel
    edges = torch.stack(
        [(column - reach).floor(), (column + reach).ceil(), (row - reach).floor(), (row + reach).ceil()]
    )
    height, width = photograph.height, photograph.width
    limits = torch.tensor([[width], [width], [height], [height]], device=edges.device)
    whole = (nearest > 0) & (edges >= 0).all(0) & (edges <= limits).all(0)
    return torch.minimum(edges.nan_to_num().clamp(min=0), limits).long(), whole


def _may_hold(photograph: Photograph, centers: Tensor, radius: float) -> Tensor:
    (x0, x1, y0, y1), whole = footprint(photograph, centers, radius)
    flat, stride = photograph.sums.view(-1), photograph.width + 1
    count = flat[y1 * stride + x1] - flat[y1 * stride + x0] - flat[y0 * stride + x1] + flat[y0 * stride + x0]
    return ~whole | (count > 0)


def hold_balls_reference(photograph: Photograph, centers: Tensor, radius: float, held: Tensor, every: bool) -> None:
    """As `hold_balls`, in torch, on any device."""
    rest = (held if every else ~held).nonzero().squeeze(-1)
    held[rest] = _may_hold(photograph, centers[rest], radius)


def hold_balls(photograph: Photograph, centers: Tensor, radius: float, held: Tensor, every: bool) -> None:
    """Note, in place, which balls a photograph does not show to be empty: not whole, or with an opaque pixel in it.

    Args:
        centers, radius: N balls, (N, 3) and their radius.
        held: (N,) bool, what is known from other photographs.
        every: True to keep what all photographs hold, starting from True; False for what any does, from False.
    """
    HOLD_BALLS((photograph.pose, centers), photograph, centers, radius, held, every)


HOLD_BALLS = Operation("hold_balls", hold_balls_reference)


@HOLD_BALLS.implementation(CPP)
def _hold_balls(photograph: Photograph, centers: Tensor, radius: float, held: Tensor, every: bool) -> None:
    address = native.pointer(held, "held", (len(centers),), torch.bool)
    _hold(*photograph.arguments(centers, radius), int(every), address, native.threads())


def pixels_near_balls_reference(photograph: Photograph, centers: Tensor, radius: float) -> Tensor:
    """As `pixels_near_balls`, in torch, on any device."""
    return _near_opaque(photograph, centers, radius) | _under_cut_balls(photograph, centers, radius)


def pixels_near_balls(photograph: Photograph, centers: Tensor, radius: float) -> Tensor:
    """Which pixels may see a ball that the photograph does not show to be empty: (H, W) bool, some more included.

    A ball that a photograph shows whole has an opaque pixel within the reach of its image, and a ray that meets the
    ball lies within that reach too: so twice the largest reach around opaque pixels is enough. Of balls that stick out
    of the photograph, every pixel that may see them is taken.

    Args:
        centers, radius: N balls, (N, 3) and their radius, none of them shown to be empty.
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
    height, width = photograph.height, photograph.width
    if bool((cut & (depth <= radius)).any()):  # the camera stands within the ball
        return torch.ones(height, width, dtype=torch.bool, device=centers.device)
    marks = torch.zeros((height + 1) * (width + 1), dtype=torch.int32, device=centers.device)
    ones = torch.ones(int(cut.sum()), dtype=torch.int32, device=centers.device)
    for x, y, sign in ((x0, y0, 1), (x1, y0, -1), (x0, y1, -1), (x1, y1, 1)):
        marks.index_add_(0, (y * (width + 1) + x)[cut], ones * sign)
    count = marks.view(height + 1, width + 1).cumsum(0).cumsum(1)
    return count[:height, :width] > 0
