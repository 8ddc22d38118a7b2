"""Solids around their own origin, intersected with rays in closed form.

Vectors are stored as (3, R), one contiguous row per axis: elementwise arithmetic on rows is several times faster than
reductions over a last axis of length 3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Return the dot products (R,) of vectors `a` and `b` (3, R)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


class Shape(Protocol):
    """A solid around the origin. Points, offsets and directions are (3, R), distances and parameters (R,).

    A line is `offset + t * direction`, where `offset` is its point closest to the origin (perpendicular to the unit
    `direction`). With this choice, all quadratics and quartics below are well conditioned.
    """

    @property
    def bound(self) -> float:
        """Radius of a sphere around the origin that contains the solid."""

    def distance(self, p: Tensor) -> Tensor:
        """Return the signed distance of points `p` to the surface, negative inside."""

    def normal(self, p: Tensor) -> Tensor:
        """Return the outward unit normals (3, R) at points `p` on the surface."""

    def enter(self, offset: Tensor, direction: Tensor, start: Tensor) -> Tensor:
        """Return the smallest parameter above `start` where the line enters the solid; inf if there is none.

        Args:
            offset, direction: the lines.
            start: parameters where the lines start.
        """

    def closest(self, offset: Tensor, direction: Tensor) -> tuple[Tensor, ...]:
        """Return the parameters of the points on lines (`offset`, `direction`) closest to or deepest in the solid."""


def _enter_interval(near: Tensor, far: Tensor, start: Tensor) -> Tensor:
    return torch.where((near < far) & (near > start), near, math.inf)


@dataclass(frozen=True)
class Sphere(Shape):
    """A ball of radius `radius`."""

    radius: float

    @property
    def bound(self) -> float:
        return self.radius

    def distance(self, p: Tensor) -> Tensor:
        return dot(p, p).sqrt() - self.radius

    def normal(self, p: Tensor) -> Tensor:
        return p / dot(p, p).sqrt()

    def enter(self, offset: Tensor, direction: Tensor, start: Tensor) -> Tensor:
        half = (self.radius**2 - dot(offset, offset)).clamp(min=0.0).sqrt()
        return _enter_interval(-half, half, start)

    def closest(self, offset: Tensor, direction: Tensor) -> tuple[Tensor, ...]:
        return (torch.zeros_like(offset[0]),)


@dataclass(frozen=True)
class Box(Shape):
    """A cuboid with axis-aligned faces; `half` is half the length of its edges along x, y and z."""

    half: tuple[float, float, float]

    @property
    def bound(self) -> float:
        return math.hypot(*self.half)

    def distance(self, p: Tensor) -> Tensor:
        q = p.abs() - self._column(p)
        outside = q.clamp(min=0.0)
        return dot(outside, outside).sqrt() + q.amax(0).clamp(max=0.0)

    def normal(self, p: Tensor) -> Tensor:
        face = torch.nn.functional.one_hot((p.abs() - self._column(p)).argmax(0), 3).T
        return face * p.sign()

    def interval(self, offset: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Return the parameters where lines enter and leave; they miss where the first is not less.

        Args:
            offset, direction: the lines.
        """
        inverse = 1.0 / torch.where(direction.abs() < 1e-12, 1e-12, direction)
        middle, reach = -offset * inverse, inverse.abs() * self._column(offset)
        return (middle - reach).amax(0), (middle + reach).amin(0)

    def enter(self, offset: Tensor, direction: Tensor, start: Tensor) -> Tensor:
        return _enter_interval(*self.interval(offset, direction), start)

    def closest(self, offset: Tensor, direction: Tensor) -> tuple[Tensor, ...]:
        near, far = self.interval(offset, direction)
        return ((0.5 * (near + far)).clamp(-self.bound, self.bound),)

    def _column(self, like: Tensor) -> Tensor:
        return like.new_tensor(self.half)[:, None]


@dataclass(frozen=True)
class BoredBox(Shape):
    """A cuboid of half edges `half` along x, y and z, with a round hole of a smaller `radius` along z."""

    half: tuple[float, float, float]
    radius: float

    @property
    def bound(self) -> float:
        return math.hypot(*self.half)

    @property
    def _box(self) -> Box:
        return Box(self.half)

    def distance(self, p: Tensor) -> Tensor:
        wall = self.radius - (p[0] ** 2 + p[1] ** 2).sqrt()  # positive in the hole
        above = (p[2].abs() - self.half[2]).clamp(min=0.0)
        in_hole = (wall.clamp(min=0.0) ** 2 + above**2).sqrt()
        return torch.where(wall > 0.0, in_hole, torch.maximum(self._box.distance(p), wall))

    def normal(self, p: Tensor) -> Tensor:
        radius = (p[0] ** 2 + p[1] ** 2).sqrt()
        on_wall = (radius - self.radius).abs() < self._box.distance(p).abs()
        inwards = torch.stack([-p[0], -p[1], torch.zeros_like(radius)]) / radius.clamp(min=1e-12)
        return torch.where(on_wall, inwards, self._box.normal(p))

    def _hole(self, offset: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
        """Return the parameters where lines enter and leave the hole, an endless cylinder; equal where they miss."""
        a = (direction[0] ** 2 + direction[1] ** 2).clamp(min=1e-20)  # for vertical lines, a very long interval
        b = offset[0] * direction[0] + offset[1] * direction[1]
        c = offset[0] ** 2 + offset[1] ** 2 - self.radius**2
        half = (b * b - a * c).clamp(min=0.0).sqrt()
        return (-b - half) / a, (-b + half) / a

    def enter(self, offset: Tensor, direction: Tensor, start: Tensor) -> Tensor:
        near, far = self._box.interval(offset, direction)
        hole_near, hole_far = self._hole(offset, direction)
        in_hole = (near > hole_near) & (near < hole_far)
        outer = torch.where((near < far) & ~in_hole & (near > start), near, math.inf)
        # Out of the hole into its wall.
        met = (hole_near < hole_far) & (hole_far > near) & (hole_far < far) & (hole_far > start)
        return torch.minimum(outer, torch.where(met, hole_far, math.inf))

    def closest(self, offset: Tensor, direction: Tensor) -> tuple[Tensor, ...]:
        near, far = self._box.interval(offset, direction)
        hole_near, hole_far = self._hole(offset, direction)
        before, behind = torch.minimum(far, hole_near), torch.maximum(near, hole_far)
        middles = (0.5 * (near + before), 0.5 * (behind + far))  # of the parts before and behind the hole
        return tuple(middle.clamp(-self.bound, self.bound) for middle in middles)


@dataclass(frozen=True)
class Cylinder(Shape):
    """A solid cylinder around z with radius `radius` and half height `half`."""

    radius: float
    half: float

    @property
    def bound(self) -> float:
        return math.hypot(self.radius, self.half)

    def distance(self, p: Tensor) -> Tensor:
        side = (p[0] ** 2 + p[1] ** 2).sqrt() - self.radius
        cap = p[2].abs() - self.half
        outside = (side.clamp(min=0.0) ** 2 + cap.clamp(min=0.0) ** 2).sqrt()
        return outside + torch.maximum(side, cap).clamp(max=0.0)

    def normal(self, p: Tensor) -> Tensor:
        radius = (p[0] ** 2 + p[1] ** 2).sqrt()
        cap = p[2].abs() - self.half > radius - self.radius
        zero = torch.zeros_like(radius)
        side = torch.stack([p[0] / radius.clamp(min=1e-12), p[1] / radius.clamp(min=1e-12), zero])
        return torch.where(cap, torch.stack([zero, zero, p[2].sign()]), side)

    def enter(self, offset: Tensor, direction: Tensor, start: Tensor) -> Tensor:
        a = (direction[0] ** 2 + direction[1] ** 2).clamp(min=1e-20)  # for vertical lines, a very long interval
        b = offset[0] * direction[0] + offset[1] * direction[1]
        c = offset[0] ** 2 + offset[1] ** 2 - self.radius**2
        discriminant = b * b - a * c
        half = discriminant.clamp(min=0.0).sqrt()
        inverse = 1.0 / torch.where(direction[2].abs() < 1e-12, 1e-12, direction[2])
        middle, reach = -offset[2] * inverse, inverse.abs() * self.half
        near = torch.maximum((-b - half) / a, middle - reach)
        far = torch.minimum((-b + half) / a, middle + reach)
        return _enter_interval(torch.where(discriminant > 0.0, near, math.inf), far, start)

    def closest(self, offset: Tensor, direction: Tensor) -> tuple[Tensor, ...]:
        a = (direction[0] ** 2 + direction[1] ** 2).clamp(min=1e-20)
        t = -(offset[0] * direction[0] + offset[1] * direction[1]) / a
        return (t.clamp(-self.bound, self.bound),)


@dataclass(frozen=True)
class Torus(Shape):
    """A ring around y: a tube of radius `minor` around a circle of radius `major`, or its `half` above z = 0."""

    major: float
    minor: float
    half: bool = False

    @property
    def bound(self) -> float:
        return self.major + self.minor

    def distance(self, p: Tensor) -> Tensor:  # the axis is y
        core = (p[0] ** 2 + p[2] ** 2).sqrt() - self.major
        tube = (core**2 + p[1] ** 2).sqrt() - self.minor
        return torch.maximum(tube, -p[2]) if self.half else tube

    def normal(self, p: Tensor) -> Tensor:
        shrink = 1.0 - self.major / (p[0] ** 2 + p[2] ** 2).sqrt()
        outward = torch.stack([p[0] * shrink, p[1], p[2] * shrink])
        return outward / dot(outward, outward).sqrt()

    def _quartic(self, offset: Tensor, direction: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return p, q, r of t^4 + p t^2 + q t + r, negative inside; from the closest point, there is no cubic term."""
        square = dot(offset, offset)
        k = square + self.major**2 - self.minor**2
        four = 4.0 * self.major**2
        a, b = direction[1], offset[1]
        return 2.0 * k - four * (1.0 - a * a), 2.0 * four * a * b, k * k - four * (square - b * b)

    @staticmethod
    def _extremes(p: Tensor, q: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the first minimum, the maximum and the second minimum of the quartic; all equal if there is only one.

        They are the roots of t^3 + p/2 t + q/4.
        """
        third, half = p / 6.0, q / 8.0
        discriminant = half**2 + third**3
        u = half.abs() + discriminant.clamp(min=1e-30).sqrt()
        u = -torch.copysign(u.pow(1.0 / 3.0), half)
        single = u - third / u
        scale = (-third).clamp(min=1e-12).sqrt()
        angle = (-half / scale**3).clamp(-1.0, 1.0).acos() / 3.0
        turn = 2.0 * math.pi / 3.0
        three = discriminant < 0.0
        return (
            torch.where(three, 2.0 * scale * (angle + turn).cos(), single),
            torch.where(three, 2.0 * scale * (angle - turn).cos(), single),
            torch.where(three, 2.0 * scale * angle.cos(), single),
        )

    def enter(self, offset: Tensor, direction: Tensor, start: Tensor) -> Tensor:
        p, q, r = self._quartic(offset, direction)

        def value(t: Tensor) -> Tensor:
            return ((t * t + p) * t + q) * t + r

        first, middle, second = self._extremes(p, q)
        # Between a point outside and a minimum inside, the quartic decreases through zero exactly once, at the entry.
        low1 = torch.maximum(-((self.bound * 1.001) ** 2 - dot(offset, offset)).clamp(min=0.0).sqrt(), start)
        low2 = torch.maximum(middle, start)
        in1 = (low1 < first) & (value(first) < 0.0) & (value(low1) > 0.0)
        in2 = (low2 < second) & (value(second) < 0.0) & (value(low2) > 0.0)
        rays = (in1 | in2).nonzero()[:, 0]
        low, high = torch.where(in1, low1, low2)[rays], torch.where(in1, first, second)[rays]
        root = _falling_root(p[rays], q[rays], r[rays], low, high)
        if self.half:  # the missing half cannot occlude: a ray through it to the arch hits the plinth first
            root = torch.where(offset[2][rays] + root * direction[2][rays] > 0.0, root, math.inf)
        return torch.full_like(p, math.inf).index_copy(0, rays, root)

    def closest(self, offset: Tensor, direction: Tensor) -> tuple[Tensor, ...]:
        p, q, _ = self._quartic(offset, direction)
        first, _, second = self._extremes(p, q)
        return first, second


@dataclass(frozen=True)
class Union(Shape):
    """Several solids as one.

    Args:
        members: each solid with the position of its origin.
    """

    members: tuple[tuple[Shape, tuple[float, float, float]], ...]

    @property
    def bound(self) -> float:
        return max(math.hypot(*centre) + shape.bound for shape, centre in self.members)

    def distance(self, p: Tensor) -> Tensor:
        return self._distances(p).amin(0)

    def normal(self, p: Tensor) -> Tensor:
        nearest = self._distances(p).abs().argmin(0)
        normals = torch.stack([shape.normal(p - _column(centre, p)) for shape, centre in self.members])
        return normals.gather(0, nearest.expand(1, 3, -1))[0]

    def enter(self, offset: Tensor, direction: Tensor, start: Tensor) -> Tensor:
        entries = [
            shape.enter(own, direction, start - shift) + shift for shape, own, shift in self._lines(offset, direction)
        ]
        return torch.stack(entries).amin(0)

    def closest(self, offset: Tensor, direction: Tensor) -> tuple[Tensor, ...]:
        lines = self._lines(offset, direction)
        return tuple(t + shift for shape, own, shift in lines for t in shape.closest(own, direction))

    def _distances(self, p: Tensor) -> Tensor:
        return torch.stack([shape.distance(p - _column(centre, p)) for shape, centre in self.members])

    def _lines(self, offset: Tensor, direction: Tensor) -> list[tuple[Shape, Tensor, Tensor]]:
        """Return each solid, the lines' points closest to its origin relative to it, and their parameters."""
        lines = []
        for shape, centre in self.members:
            relative = offset - _column(centre, offset)
            shift = -dot(relative, direction)
            lines.append((shape, relative + shift * direction, shift))
        return lines


def _column(vector: tuple[float, float, float], like: Tensor) -> Tensor:
    return like.new_tensor(vector)[:, None]


def _falling_root(p: Tensor, q: Tensor, r: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """Return the root of t^4 + p t^2 + q t + r between `low` (positive) and `high` (negative), by guarded Newton."""
    t = 0.5 * (low + high)
    for _ in range(24 if p.dtype == torch.float64 else 12):
        value = ((t * t + p) * t + q) * t + r
        low, high = torch.where(value > 0.0, t, low), torch.where(value > 0.0, high, t)
        step = t - value / ((4.0 * t * t + 2.0 * p) * t + q)
        t = torch.where((step >= low) & (step <= high), step, 0.5 * (low + high))  # an exact root is a bound itself
    return t
