"""Lenses: what a camera does between a direction and a place on its picture.

Here a place is in normalised image coordinates: pixels from the principal point over the focal length, x to the right
and y down. A direction is in the camera's frame: x right, y up, -z ahead.

opencv and fisheye bend a point p of the plane in the same way, p being a direction over its depth for opencv, and the
angle off the axis times the unit vector towards the point for fisheye:

    bend(p) = p N(q) / D(q) + tangential(p),  q = |p|^2,
    N = 1 + k1 q + k2 q^2 + k3 q^3 + k7 q^4,  D = 1 + k4 q + k5 q^2 + k6 q^3

(the rational model of OpenCV, and Kannala and Brandt 2006). It is the gradient of a function: its Jacobian is
symmetric, and where that is positive definite on a whole disk, no two points of the disk are bent to the same place. So
the largest such disk, whose radius is the lens's `reach`, is where a place has one ray; Newton's iteration that never
leaves it finds no wrong root. Polynomials fitted to a lens mean nothing beyond: they fold the picture over.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
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
"""Projection -> its distortion coefficients. opencv is OpenCV's rational model, k4 to k6 being the denominator's, and
k7 the numerator's r^8, which transforms.json calls k4; fisheye is Kannala and Brandt's, as OpenCV has it."""
BENDING = ("opencv", "fisheye")
"""The models that have distortion."""
_FISHEYE_PLACES = [0, 1, 4, 8]
"""Where the coefficients of fisheye stand among those of opencv: all are the numerator's."""
FARTHEST = {"opencv": math.tan(math.radians(89.9)), "fisheye": math.pi}
"""Radius at which `reach` is looked for no further: opencv sees no direction at 90 degrees, and none is beyond 180."""
RADII = 4096
"""Radii at which a lens is looked at to find where it folds."""
SMALLEST_DENOMINATOR = 1e-2
"""Where D comes to 0 places run off to infinity; a lens is taken to reach less far."""
ITERATIONS = 60
"""Newton's, at most. Four are usual; next to the reach, where the Jacobian vanishes, they converge more slowly."""
SMALLEST_AREA = 1e-3
"""Least determinant of a Jacobian that a pixel's cone is given: at the reach it is 0, and the cone would be endless."""


class Seen(NamedTuple):
    """What R places on a picture show."""

    directions: Tensor
    """(R, 3) in the camera's frame; unit vectors, and finite even where there is no ray."""
    spread: Tensor
    """(R,) angle between the rays of neighbouring places, radians per unit of normalised image coordinates."""
    found: Tensor
    """(R,) bool: False where no ray leads to the place."""


@dataclass(frozen=True)
class Distortion:
    """The bending of M lenses, in float64 where the device has it: undoing it then adds nothing to a ray's rounding."""

    coefficients: Tensor
    """(M, 9) as `LENSES["opencv"]` names them, whichever the model."""
    reach: Tensor
    """(M,) radius of the disk on which places and directions are one to one."""
    bounds: Tensor
    """(M, 2) distances of places from the principal point: all nearer than the first have a ray, none beyond the
    second."""

    @classmethod
    def of(cls, model: str, lens: Tensor) -> Distortion:
        """The bending of the lenses (M, K) of a model in `BENDING`."""
        exact = lens.to(_precise(lens))
        coefficients = exact
        if model == "fisheye":
            coefficients = exact.new_zeros(len(exact), len(LENSES["opencv"]))
            coefficients[:, _FISHEYE_PLACES] = exact
        kinds, which = torch.unique(coefficients, dim=0, return_inverse=True)  # photographs mostly share a lens
        reach = find_reach(kinds, FARTHEST[model])[which]
        edge = reach * radial(reach.square(), coefficients)[0]
        most = 3 * coefficients[:, 2:4].norm(dim=-1) * reach.square()  # that the tangential part can move a place by
        return cls(coefficients, reach, torch.stack([edge - most, edge + most], dim=-1))

    def __getitem__(self, index: Tensor) -> Distortion:
        return Distortion(self.coefficients[index], self.reach[index], self.bounds[index])

    @cached_property
    def table(self) -> Tensor:
        """(M, 11) coefficients, reach and outer bound: what the compiled kernel reads."""
        return torch.cat([self.coefficients, self.reach[:, None], self.bounds[:, 1:]], dim=-1).contiguous()


def radial(squared: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """How much longer a lens makes a radius: N / D, its derivative by the squared radius, and D.

    Args:
        squared: (...,) radii, squared.
        coefficients: (..., 9).
    """
    k1, k2, _, _, k3, k4, k5, k6, k7 = coefficients.unbind(-1)
    denominator = 1 + squared * (k4 + squared * (k5 + squared * k6))
    scale = (1 + squared * (k1 + squared * (k2 + squared * (k3 + squared * k7)))) / denominator
    slope = k1 + squared * (2 * k2 + squared * (3 * k3 + squared * 4 * k7))
    slope = (slope - scale * (k4 + squared * (2 * k5 + squared * 3 * k6))) / denominator
    return scale, slope, denominator


def bend(x: Tensor, y: Tensor, coefficients: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor]]:
    """Where points (R,), (R,) are bent to, and the Jacobian's entries: du/dx, du/dy = dv/dx, dv/dy."""
    p1, p2 = coefficients[..., 2], coefficients[..., 3]
    squared = x * x + y * y
    scale, slope, _ = radial(squared, coefficients)
    u = x * scale + 2 * p1 * x * y + p2 * (squared + 2 * x * x)
    v = y * scale + p1 * (squared + 2 * y * y) + 2 * p2 * x * y
    uu = scale + 2 * slope * x * x + 2 * p1 * y + 6 * p2 * x
    uv = 2 * (slope * x * y + p1 * x + p2 * y)
    vv = scale + 2 * slope * y * y + 6 * p1 * y + 2 * p2 * x
    return u, v, (uu, uv, vv)


def find_reach(coefficients: Tensor, farthest: float) -> Tensor:
    """(M,) radius of the largest disk around 0 on which the Jacobian of `bend` is surely positive definite.

    Its eigenvalues are those of the radial part, f'(r) and f(r) / r of the bent radius f, less 6 |(p1, p2)| r at most.
    """

    def one_to_one(radius: Tensor) -> Tensor:
        scale, slope, denominator = radial(radius.square(), coefficients[:, None])
        least = torch.minimum(scale, scale + 2 * radius.square() * slope)
        return (denominator > SMALLEST_DENOMINATOR) & (least > 6 * coefficients[:, None, 2:4].norm(dim=-1) * radius)

    angles = torch.linspace(0, 1, RADII, dtype=coefficients.dtype, device=coefficients.device) * math.atan(farthest)
    radii = angles.tan().expand(len(coefficients), RADII)
    good = one_to_one(radii).to(torch.int8).cumprod(-1).sum(-1, keepdim=True)
    low = radii.gather(-1, (good - 1).clamp(min=0))
    high = radii.gather(-1, good.clamp(max=RADII - 1))
    for _ in range(40):
        middle = (low + high) / 2
        fine = one_to_one(middle)
        low, high = torch.where(fine, middle, low), torch.where(fine, high, middle)
    return low[:, 0]


def straighten(u: Tensor, v: Tensor, lenses: Distortion) -> tuple[Tensor, Tensor, Tensor]:
    """The points of the disk that `bend` takes to places (R,), (R,), by damped Newton iteration.

    A step that does not come nearer is halved; one that would leave the disk ends half way to its edge.

    Args:
        u, v: places.
        lenses: the lens of each of the R.
    Returns: x, y (R,), and (R,) bool whether the point was found; if not, x and y are those of the disk's edge.
    """
    reach, distance = lenses.reach, torch.hypot(u, v)
    x = y = torch.zeros_like(u)
    best = torch.full_like(u, torch.inf)
    start = torch.where(distance < reach, 1.0, 0.9 * reach / distance)
    step_x, step_y = u * start, v * start
    possible = distance <= lenses.bounds[:, 1]
    tolerance = (1e-9 if u.dtype == torch.float64 else 1e-6) ** 2 * (1 + distance.square())
    for _ in range(ITERATIONS):
        at_x, at_y = x + step_x, y + step_y
        bent_u, bent_v, (uu, uv, vv) = bend(at_x, at_y, lenses.coefficients)
        off_u, off_v = bent_u - u, bent_v - v
        error = off_u * off_u + off_v * off_v
        better = error < best
        x, y, best = torch.where(better, at_x, x), torch.where(better, at_y, y), torch.where(better, error, best)
        if bool(((best <= tolerance) | ~possible).all()):
            break
        area = (uu * vv - uv * uv).clamp(min=1e-12)
        step_x = torch.where(better, (uv * off_v - vv * off_u) / area, step_x / 2)
        step_y = torch.where(better, (uv * off_u - uu * off_v) / area, step_y / 2)
        radius = torch.hypot(x + step_x, y + step_y)
        shrink = torch.where(radius < reach, 1.0, (torch.hypot(x, y) + reach) / (2 * radius))
        step_x, step_y = (x + step_x) * shrink - x, (y + step_y) * shrink - y
    found = possible & (best <= tolerance)
    edge = reach / distance.clamp(min=1e-30)
    return torch.where(found, x, u * edge), torch.where(found, y, v * edge), found


def unproject(model: str, x: Tensor, y: Tensor, lenses: Distortion | None) -> Seen:
    """The directions that places (R,), (R,) show.

    Args:
        model: a key of `LENSES`; for orthographic all directions are the camera's.
        x, y: normalised image coordinates; for equirectangular longitude and latitude (down) in radians.
        lenses: the lens of each of the R, for the models in `BENDING`.
    """
    one = torch.ones_like(x)
    if model == "pinhole":
        return _ahead(x, y, one, one.bool())
    if model == "orthographic":
        return Seen(torch.stack([0 * x, 0 * y, -one], dim=-1), one, one.bool())
    if model == "equirectangular":
        around, up = y.cos(), -y.sin()
        found = (x.abs() <= math.pi + 1e-4) & (y.abs() <= math.pi / 2 + 1e-4)
        return Seen(torch.stack([x.sin() * around, up, -x.cos() * around], dim=-1), around.clamp(min=0).sqrt(), found)
    assert lenses is not None
    precise_x, precise_y, found = straighten(x.to(lenses.reach), y.to(lenses.reach), lenses)
    uu, uv, vv = bend(precise_x, precise_y, lenses.coefficients)[2]
    area = (uu * vv - uv * uv).clamp(min=SMALLEST_AREA)
    if model == "opencv":
        seen = _ahead(precise_x, precise_y, area, found)
    else:
        angle = torch.hypot(precise_x, precise_y)
        shorter = torch.sinc(angle / math.pi).clamp(min=0)  # sin(angle) / angle
        directions = torch.stack([precise_x * shorter, -precise_y * shorter, -angle.cos()], dim=-1)
        seen = Seen(directions, (shorter / area).sqrt(), found)
    return Seen(seen.directions.to(x), seen.spread.to(x), found)


def _ahead(x: Tensor, y: Tensor, area: Tensor, found: Tensor) -> Seen:
    """Directions over their depth; `area` is that of the picture over that of the plane at depth 1."""
    local = torch.stack([x, -y, -torch.ones_like(x)], dim=-1)
    length = local.norm(dim=-1)
    return Seen(local / length[:, None], 1 / (length * area.sqrt()), found)


def project(model: str, local: Tensor, lenses: Distortion | None) -> tuple[Tensor, Tensor, Tensor]:
    """The places that show points (N, 3) of the camera's frame; the inverse of `unproject`.

    Args:
        lenses: the lens of each of the N, for the models in `BENDING`.
    Returns: x, y (N,) in normalised image coordinates, and (N,) bool whether the camera sees such a point: in front of
        it and within the lens's reach. x and y are finite where it does not.
    """
    right, down, depth = local[:, 0], -local[:, 1], -local[:, 2]
    if model == "orthographic":
        return right, down, depth > 0
    off_axis = torch.hypot(right, down)
    if model == "equirectangular":
        latitude = torch.atan2(down, torch.hypot(right, depth))
        return torch.atan2(right, depth), latitude, local.norm(dim=-1) > 0
    seen = depth > 0
    if model == "fisheye":
        scale = torch.atan2(off_axis, depth) / off_axis.clamp(min=1e-30)
        scale = torch.where((off_axis < 1e-12) & seen, 1 / depth.clamp(min=1e-30), scale)
    else:
        scale = 1 / torch.where(seen, depth, 1.0)
    x, y = right * scale, down * scale
    if model == "pinhole":
        return x, y, seen
    assert lenses is not None
    radius = torch.hypot(x, y)
    within = radius <= lenses.reach
    seen = within & (off_axis + depth.abs() > 0) if model == "fisheye" else within & seen
    shrink = torch.where(within, 1.0, lenses.reach / radius)
    u, v, _ = bend((x * shrink).to(lenses.reach), (y * shrink).to(lenses.reach), lenses.coefficients)
    return u.to(x), v.to(x), seen


def panorama(width: float, height: float) -> tuple[float, float, float, float]:
    """fx, fy (pixels per radian), cx, cy (pixels) of an equirectangular picture of all directions."""
    return width / (2 * math.pi), height / math.pi, width / 2, height / 2


def _precise(like: Tensor) -> torch.dtype:
    """float64, which MPS has not."""
    return torch.float32 if like.device.type == "mps" else torch.float64
