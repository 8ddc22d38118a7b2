"""Lens models: from directions in the camera's frame to positions on the image plane, and back.

A position on the image plane is in normalised image coordinates: pixels from the principal point over the focal length,
x to the right and y down. A direction is in the camera's frame: x right, y up, -z forward.

opencv and fisheye distort a point p of the plane in the same way. For opencv, p is the direction divided by its depth;
for fisheye, it is the angle to the optical axis times the unit vector from the axis towards the point:

    distort(p) = p N(q) / D(q) + tangential(p),  q = |p|^2,
    N = 1 + k1 q + k2 q^2 + k3 q^3 + k7 q^4,  D = 1 + k4 q + k5 q^2 + k6 q^3

(OpenCV's rational model; Kannala and Brandt 2006). The map is the gradient of a scalar function, so its Jacobian is
symmetric; on a disk where the Jacobian is positive definite, the map is one to one. The lens's `reach` is the radius of
the largest such disk. Each position in this disk has one ray, and a Newton iteration that stays in the disk cannot find
a wrong root. Beyond the reach, polynomials fitted to a lens are meaningless: they fold the image over.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

LENSES: dict[str, tuple[str, ...]] = {
    "pinhole": (),
    "opencv": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "k7"),
    "fisheye": ("k1", "k2", "k3", "k4"),
    "equirectangular": (),
    "orthographic": (),
}
"""Projection -> names of its distortion coefficients. opencv is OpenCV's rational model: k4 to k6 belong to the
denominator, and k7 is the numerator's r^8, which transforms.json calls k4. fisheye is Kannala and Brandt's model, as
in OpenCV."""
DISTORTED = ("opencv", "fisheye")
"""Projections with distortion."""
_FISHEYE_INDICES = [0, 1, 4, 8]
"""Indices of fisheye's coefficients among opencv's; all belong to the numerator."""
MAXIMUM_REACH = {"opencv": math.tan(math.radians(89.9)), "fisheye": math.pi}
"""Maximum of `reach`: opencv shows no direction at 90 degrees from the axis, and fisheye none beyond 180."""
RADII = 4096
"""Number of radii where the Jacobian is tested to find the reach."""
MIN_DENOMINATOR = 1e-2
"""Minimum of D within the reach; where D approaches 0, positions go to infinity."""
MAX_ITERATIONS = 60
"""Maximum number of Newton iterations. Four are usual; near the reach, where the Jacobian vanishes, more are needed."""
MIN_AREA = 1e-3
"""Minimum determinant of the Jacobian for a pixel's cone; at the reach it is 0, and the cone's width infinite."""


class LensRays(NamedTuple):
    """Directions in the camera's frame of R positions on the image plane."""

    directions: Tensor
    """(R, 3) unit directions, finite even where there is no ray."""
    spread: Tensor
    """(R,) angle between the rays of neighbouring positions, radians per unit of normalised image coordinates."""
    valid: Tensor
    """(R,) bool: False for a position without a ray."""


@dataclass(frozen=True)
class Distortion:
    """The distortion of M lenses, in float64 if the device has it, so that its inverse adds no error to a ray."""

    coefficients: Tensor
    """(M, 9) coefficients in the order of `LENSES["opencv"]`, for both models."""
    reach: Tensor
    """(M,) radius of the disk where the distortion is one to one."""
    bounds: Tensor
    """(M, 2) radii of distorted positions: all within the first have a ray, and none beyond the second has."""
    iterations: int | None = None
    """Newton iterations that `undistort` takes; if None, it asks after each whether another is needed."""

    @classmethod
    def of(cls, model: str, lens: Tensor) -> Distortion:
        """Return the distortion of M lenses of a `model` in `DISTORTED`, with coefficients `lens` (M, K)."""
        precise = lens.to(_precise_dtype(lens))
        coefficients = precise
        if model == "fisheye":
            coefficients = precise.new_zeros(len(precise), len(LENSES["opencv"]))
            coefficients[:, _FISHEYE_INDICES] = precise
        unique, index = torch.unique(coefficients, dim=0, return_inverse=True)  # most images share a lens
        reach = find_reach(unique, MAXIMUM_REACH[model])[index]
        edge = reach * radial(reach.square(), coefficients)[0]
        tangential = 3 * coefficients[:, 2:4].norm(dim=-1) * reach.square()  # the largest tangential displacement
        return cls(coefficients, reach, torch.stack([edge - tangential, edge + tangential], dim=-1))

    def __getitem__(self, index: Tensor) -> Distortion:
        return Distortion(self.coefficients[index], self.reach[index], self.bounds[index], self.iterations)

    def to(self, like: Tensor) -> Distortion:
        """Return the distortion on the device and in the float type of `like`."""
        return Distortion(self.coefficients.to(like), self.reach.to(like), self.bounds.to(like), self.iterations)

    @cached_property
    def table(self) -> Tensor:
        """(M, 11) coefficients, reach and outer bound, the input of the compiled kernel."""
        return torch.cat([self.coefficients, self.reach[:, None], self.bounds[:, 1:]], dim=-1).contiguous()


def radial(squared: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the radial scale N / D, its derivative with respect to the squared radius, and D.

    Args:
        squared: (...,) squared radii.
        coefficients: (..., 9) in the order of `LENSES["opencv"]`.
    """
    k1, k2, _, _, k3, k4, k5, k6, k7 = coefficients.unbind(-1)
    denominator = 1 + squared * (k4 + squared * (k5 + squared * k6))
    scale = (1 + squared * (k1 + squared * (k2 + squared * (k3 + squared * k7)))) / denominator
    slope = k1 + squared * (2 * k2 + squared * (3 * k3 + squared * 4 * k7))
    slope = (slope - scale * (k4 + squared * (2 * k5 + squared * 3 * k6))) / denominator
    return scale, slope, denominator


def distort(x: Tensor, y: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor]]:
    """Distort points of the image plane.

    Args:
        x, y: (R,) undistorted coordinates.
        coefficients: (R, 9) or (9,) in the order of `LENSES["opencv"]`.

    Returns:
        u and v (R,), the distorted coordinates, and the entries du/dx, du/dy = dv/dx and dv/dy (R,) of the Jacobian.
    """
    p1, p2 = coefficients[..., 2], coefficients[..., 3]
    squared = x * x + y * y
    scale, slope, _ = radial(squared, coefficients)
    u = x * scale + 2 * p1 * x * y + p2 * (squared + 2 * x * x)
    v = y * scale + p1 * (squared + 2 * y * y) + 2 * p2 * x * y
    uu = scale + 2 * slope * x * x + 2 * p1 * y + 6 * p2 * x
    uv = 2 * (slope * x * y + p1 * x + p2 * y)
    vv = scale + 2 * slope * y * y + 6 * p1 * y + 2 * p2 * x
    return u, v, (uu, uv, vv)


def find_reach(coefficients: Tensor, maximum: float) -> Tensor:
    """Return the radius (M,) of the largest disk around 0 where the Jacobian of `distort` is positive definite.

    With f the distorted radius, the eigenvalues are at least f'(r) and f(r) / r, less 6 |(p1, p2)| r.

    Args:
        coefficients: (M, 9) in the order of `LENSES["opencv"]`.
        maximum: upper limit of the radius.
    """

    def one_to_one(radius: Tensor) -> Tensor:
        scale, slope, denominator = radial(radius.square(), coefficients[:, None])
        least = torch.minimum(scale, scale + 2 * radius.square() * slope)
        return (denominator > MIN_DENOMINATOR) & (least > 6 * coefficients[:, None, 2:4].norm(dim=-1) * radius)

    angles = torch.linspace(0, 1, RADII, dtype=coefficients.dtype, device=coefficients.device) * math.atan(maximum)
    radii = angles.tan().expand(len(coefficients), RADII)
    good = one_to_one(radii).to(torch.int8).cumprod(-1).sum(-1, keepdim=True)
    low = radii.gather(-1, (good - 1).clamp(min=0))
    high = radii.gather(-1, good.clamp(max=RADII - 1))
    for _ in range(40):
        middle = (low + high) / 2
        fine = one_to_one(middle)
        low, high = torch.where(fine, middle, low), torch.where(fine, high, middle)
    return low[:, 0]


def undistort(u: Tensor, v: Tensor, lenses: Distortion) -> tuple[Tensor, Tensor, Tensor]:
    """Invert `distort` within the reach, by a damped Newton iteration.

    A step that does not reduce the error is halved; one that would leave the disk ends half way to its edge.

    Args:
        u, v: (R,) distorted coordinates.
        lenses: the R lenses, one for each point.

    Returns:
        x and y (R,), the undistorted coordinates, and (R,) bool, whether the iteration converged; where it did not, x
        and y lie on the disk's edge.
    """
    reach, distance = lenses.reach, torch.hypot(u, v)
    x = y = torch.zeros_like(u)
    best = torch.full_like(u, torch.inf)
    start = torch.where(distance < reach, 1.0, 0.9 * reach / distance)
    step_x, step_y = u * start, v * start
    possible = distance <= lenses.bounds[:, 1]
    tolerance = (1e-9 if u.dtype == torch.float64 else 1e-6) ** 2 * (1 + distance.square())
    for _ in range(lenses.iterations or MAX_ITERATIONS):
        at_x, at_y = x + step_x, y + step_y
        bent_u, bent_v, (uu, uv, vv) = distort(at_x, at_y, lenses.coefficients)
        off_u, off_v = bent_u - u, bent_v - v
        error = off_u * off_u + off_v * off_v
        better = error < best
        x, y, best = torch.where(better, at_x, x), torch.where(better, at_y, y), torch.where(better, error, best)
        if lenses.iterations is None and bool(((best <= tolerance) | ~possible).all()):
            break
        area = (uu * vv - uv * uv).clamp(min=1e-12)
        step_x = torch.where(better, (uv * off_v - vv * off_u) / area, step_x / 2)
        step_y = torch.where(better, (uv * off_u - uu * off_v) / area, step_y / 2)
        radius = torch.hypot(x + step_x, y + step_y)
        shrink = torch.where(radius < reach, 1.0, (torch.hypot(x, y) + reach) / (2 * radius))
        step_x, step_y = (x + step_x) * shrink - x, (y + step_y) * shrink - y
    valid = possible & (best <= tolerance)
    edge = reach / distance.clamp(min=1e-30)
    return torch.where(valid, x, u * edge), torch.where(valid, y, v * edge), valid


def iterations_needed(u: Tensor, v: Tensor, lenses: Distortion) -> int:
    """Return the iterations that `undistort` needs for positions `u, v` (R,) of R `lenses`, plus one."""
    found = undistort(u, v, lenses)[2]
    for count in range(1, MAX_ITERATIONS):
        if bool((undistort(u, v, replace(lenses, iterations=count))[2] | ~found).all()):
            return count + 1
    return MAX_ITERATIONS


def unproject(model: str, x: Tensor, y: Tensor, lenses: Distortion | None) -> LensRays:
    """Return the directions of positions on the image plane.

    Args:
        model: a key of `LENSES`. For orthographic, all directions are the camera's.
        x, y: (R,) normalised image coordinates; for equirectangular, longitude and latitude (down) in radians.
        lenses: the R lenses, one for each position, for the models in `DISTORTED`.
    """
    one = torch.ones_like(x)
    if model == "pinhole":
        return _at_depth_1(x, y, one, one.bool())
    if model == "orthographic":
        return LensRays(torch.stack([0 * x, 0 * y, -one], dim=-1), one, one.bool())
    if model == "equirectangular":
        around, up = y.cos(), -y.sin()
        valid = (x.abs() <= math.pi + 1e-4) & (y.abs() <= math.pi / 2 + 1e-4)
        return LensRays(
            torch.stack([x.sin() * around, up, -x.cos() * around], dim=-1), around.clamp(min=0).sqrt(), valid
        )
    assert lenses is not None
    precise_x, precise_y, valid = undistort(x.to(lenses.reach), y.to(lenses.reach), lenses)
    uu, uv, vv = distort(precise_x, precise_y, lenses.coefficients)[2]
    area = (uu * vv - uv * uv).clamp(min=MIN_AREA)
    if model == "opencv":
        rays = _at_depth_1(precise_x, precise_y, area, valid)
    else:
        angle = torch.hypot(precise_x, precise_y)
        shorter = torch.sinc(angle / math.pi).clamp(min=0)  # sin(angle) / angle
        directions = torch.stack([precise_x * shorter, -precise_y * shorter, -angle.cos()], dim=-1)
        rays = LensRays(directions, (shorter / area).sqrt(), valid)
    return LensRays(rays.directions.to(x), rays.spread.to(x), valid)


def _at_depth_1(x: Tensor, y: Tensor, area: Tensor, valid: Tensor) -> LensRays:
    """Normalise directions given at depth 1; `area` is the ratio of areas, distorted over undistorted."""
    local = torch.stack([x, -y, -torch.ones_like(x)], dim=-1)
    length = local.norm(dim=-1)
    return LensRays(local / length[:, None], 1 / (length * area.sqrt()), valid)


def project(model: str, local: Tensor, lenses: Distortion | None) -> tuple[Tensor, Tensor, Tensor]:
    """Project points of the camera's frame to the image plane; the inverse of `unproject`. Differentiable.

    Args:
        model: a key of `LENSES`.
        local: (N, 3) points in the camera's frame.
        lenses: one lens, or the N lenses, one for each point, for the models in `DISTORTED`.

    Returns:
        x and y (N,) in normalised image coordinates, and (N,) bool, whether the camera sees the point. It sees points
        in front of it and within the lens's reach. x and y of other points are finite, too; a point beyond the reach is
        moved to its edge.
    """
    right, down, depth = local[:, 0], -local[:, 1], -local[:, 2]
    visible = depth > 0
    if model == "orthographic":
        return right, down, visible
    if model == "equirectangular":
        vertical = (right == 0) & (depth == 0)
        ahead = torch.where(vertical, 1.0, depth)  # gradients of `hypot` and `atan2` are NaN at 0
        latitude = torch.atan2(down, torch.where(vertical, 0.0, torch.hypot(right, ahead)))
        return torch.atan2(right, ahead), latitude, local.detach().norm(dim=-1) > 0
    if model == "fisheye":
        on_axis = right.abs() + down.abs() < 1e-12  # behind the camera, such a point has no position
        off_axis = torch.hypot(torch.where(on_axis, 1.0, right), down)
        scale = torch.atan2(off_axis, depth) / off_axis
        scale = torch.where(on_axis, 1 / torch.where(on_axis & visible, depth, 1.0), scale)
        visible = visible | ~on_axis
    else:
        scale = 1 / torch.where(visible, depth, 1.0)
    x, y = right * scale, down * scale
    if model == "pinhole":
        return x, y, visible
    assert lenses is not None
    within = torch.hypot(x.detach(), y.detach()) <= lenses.reach
    shrink = torch.where(within, 1.0, lenses.reach / torch.hypot(torch.where(within, 1.0, x), y))
    u, v, _ = distort((x * shrink).to(lenses.reach), (y * shrink).to(lenses.reach), lenses.coefficients)
    return u.to(x), v.to(x), within & visible


def panorama(width: float, height: float) -> tuple[float, float, float, float]:
    """Return fx, fy (pixels per radian), cx, cy of an equirectangular image of `width` x `height` pixels."""
    return width / (2 * math.pi), height / math.pi, width / 2, height / 2


def _precise_dtype(like: Tensor) -> torch.dtype:
    """Return float64, or float32 on MPS, which lacks float64."""
    return torch.float32 if like.device.type == "mps" else torch.float64
