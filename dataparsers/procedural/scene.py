"""The embedded scene: solids with procedural textures in sunlight, ray traced in closed form.

Coordinates are scene units with z up; everything lies strictly inside +-1.4. Depth, normals and occupancy are exact up
to rounding in the floating point type of the rays, so the scene is also the ground truth of accuracy tests. Colours are
display values in [0, 1], as stored in a PNG. Vectors are (3, R) in this file; public functions take and return (R, 3).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nerfloom.dataparsers.procedural.shapes import Box, Cylinder, Shape, Sphere, Torus, dot

Colour = tuple[float, float, float]
"""Red, green and blue."""
_CREAM, _SAND, _SLATE = (0.90, 0.85, 0.74), (0.62, 0.50, 0.35), (0.035, 0.075, 0.115)
_RED, _TEAL, _OCHRE, _BRASS = (0.60, 0.045, 0.05), (0.0, 0.20, 0.24), (0.80, 0.38, 0.045), (0.45, 0.26, 0.08)


def smoothstep(low: float, high: float, x: Tensor) -> Tensor:
    """Interpolate `x` smoothly by a cubic, from 0 at `low` to 1 at `high`, which may be less than `low`."""
    t = ((x - low) / (high - low)).clamp(0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def mix(a: Tensor, b: Tensor, weight: Tensor) -> Tensor:
    """Interpolate linearly from `a` (`weight` 0) to `b` (`weight` 1)."""
    return a + (b - a) * weight


def blend(a: Colour, b: Colour, weight: Tensor) -> Tensor:
    """Return colours (3, R) between `a` (`weight` 0) and `b` (`weight` 1), for weights (R,)."""
    return torch.stack([x + (y - x) * weight for x, y in zip(a, b, strict=True)])


def wave(x: Tensor, sharpness: float) -> Tensor:
    """Return a square wave of `x` of period 2 pi, in [-1, 1], with flanks of slope `sharpness`."""
    return (x.sin() * sharpness).clamp(-1.0, 1.0)


def checks(light: Colour, dark: Colour, frequency: float, p: Tensor) -> Tensor:
    """Return a checkerboard in space, (3, R) at points `p`: `light` and `dark` cells of edge pi / `frequency`."""
    value = torch.ones_like(p[0])
    for row in p:
        value = value * wave(row * frequency + 0.4, 5.0)
    return blend(dark, light, 0.5 + 0.5 * value)


def _plinth_texture(p: Tensor) -> Tensor:
    """Return a fine checkerboard inside a ring of tick marks, and a fluted rim."""
    radius = (p[0] ** 2 + p[1] ** 2).sqrt()
    angle = torch.atan2(p[1], p[0])
    cells = wave(p[0] * (math.pi / 0.08), 8.0) * wave(p[1] * (math.pi / 0.08), 8.0)
    floor = blend(_CREAM, _SAND, 0.5 + 0.5 * cells)
    ticks = blend(_SLATE, _CREAM, 0.5 + 0.5 * wave(angle * 90.0, 3.0))
    band = smoothstep(0.985, 0.995, radius) * (1.0 - smoothstep(1.065, 1.075, radius))
    border = blend(_SLATE, _TEAL, smoothstep(-0.04, 0.04, p[2]) * (0.5 + 0.5 * wave(angle * 60.0, 1.5)))
    return mix(mix(floor, border, smoothstep(0.955, 0.965, radius)), ticks, band * (p[2] > 0.0))


def _make_glyphs(cells: int = 3) -> Tensor:
    """Return the ink (6, 7 cells, 7 cells) of the six faces of the box: mirrored 5x5 glyphs of an invented alphabet."""
    half = np.random.default_rng(7).random((6, cells, cells, 5, 3)) < 0.55
    signs = np.concatenate([half, half[..., 1::-1]], axis=-1)
    padded = np.pad(signs, ((0, 0), (0, 0), (0, 0), (1, 1), (1, 1)))
    ink = padded.transpose(0, 1, 3, 2, 4).reshape(6, 7 * cells, 7 * cells)
    return torch.from_numpy(ink.astype(np.float32))


_GLYPHS = _make_glyphs()


def _box_texture(p: Tensor, half: float) -> Tensor:
    """Return rows of glyphs; ink is interpolated between texel centres, so that the texture is continuous."""
    axis = p.abs().argmax(0)
    face = axis * 2 + (p.gather(0, axis[None])[0] > 0)
    u, v = torch.where(axis == 0, p[1], p[0]), torch.where(axis == 2, p[1], p[2])
    size = _GLYPHS.shape[-1]
    x, y = ((c / (2.0 * half) + 0.5) * size - 0.5 for c in (u, v))
    i, j = x.floor(), y.floor()
    wx, wy = smoothstep(0.3, 0.7, x - i), smoothstep(0.3, 0.7, y - j)

    def ink(di: int, dj: int) -> Tensor:
        row, column = ((c.long() + d).clamp(0, size - 1) for c, d in ((j, dj), (i, di)))
        return _GLYPHS.to(p).flatten()[(face * size + row) * size + column]

    value = mix(mix(ink(0, 0), ink(1, 0), wx), mix(ink(0, 1), ink(1, 1), wx), wy)
    return blend(_TEAL, _CREAM, value)


def _ring_texture(p: Tensor, major: float) -> Tensor:
    """Return stripes that wind around the tube like a twisted rope."""
    along = torch.atan2(p[2], p[0])
    around = torch.atan2(p[1], (p[0] ** 2 + p[2] ** 2).sqrt() - major)
    return blend(_OCHRE, _CREAM, 0.5 + 0.5 * wave(16.0 * along + 2.0 * around, 4.0))


def _bob_texture(p: Tensor) -> Tensor:
    """Return the pattern of a gyroid's level set, a smooth labyrinth."""
    x, y, z = p * 60.0
    value = x.sin() * y.cos() + y.sin() * z.cos() + z.sin() * x.cos()
    return blend(_SLATE, _CREAM, smoothstep(-0.3, 0.3, value))


# ---- The scene ------------------------------------------------------------------------------------------------


class Part(NamedTuple):
    """One solid, as placed at time 0.

    Args:
        shape: the solid around its own origin.
        centre: position of its origin, scene units.
        yaw: rotation about z, radians.
        texture: function from positions (3, R) around its origin to albedo (3, R).
        gloss: strength of the specular reflection; 0 is matte, with the same colour from every direction.
        shadow: whether it casts a shadow on the other solids.
    """

    shape: Shape
    centre: tuple[float, float, float]
    yaw: float
    texture: Callable[[Tensor], Tensor]
    gloss: float
    shadow: bool = True


Parts = Mapping[str, Part]
"""The solids of a scene by name."""
_TOP = -0.45  # height of the plinth's upper face
_BALL_ORBIT, _BALL_ANGLE = 0.56, math.radians(197.0)
_BALL, _CUBE, _RING = Sphere(0.36), Box((0.26, 0.26, 0.26)), Torus(0.27, 0.085)
_BALL_CENTRE = (_BALL_ORBIT * math.cos(_BALL_ANGLE), _BALL_ORBIT * math.sin(_BALL_ANGLE), _TOP + _BALL.radius)

PARTS: dict[str, Part] = {
    "plinth": Part(  # all other parts are above it
        Cylinder(1.15, 0.08), (0.0, 0.0, _TOP - 0.08), 0.0, _plinth_texture, 0.0, shadow=False
    ),
    "ball": Part(_BALL, _BALL_CENTRE, 0.0, lambda p: blend(_RED, _RED, p[0]), 1.0),
    "box": Part(_CUBE, (0.60, -0.10, _TOP + 0.26), 0.45, lambda p: _box_texture(p, _CUBE.half[0]), 0.0),
    "ring": Part(_RING, (0.08, 0.62, _TOP + 0.355), -0.35, lambda p: _ring_texture(p, _RING.major), 0.0),
    "arch": Part(
        Torus(1.02, 0.018, half=True), (0.0, 0.0, _TOP - 0.08), 2.36, lambda p: blend(_BRASS, _BRASS, p[0]), 0.4
    ),
    "string": Part(Cylinder(0.015, 0.11), (0.0, 0.0, 0.39), 0.0, lambda p: blend(_BRASS, _BRASS, p[0]), 0.0),
    "bob": Part(Sphere(0.13), (0.0, 0.0, 0.16), 0.0, _bob_texture, 0.0),
}
"""The solids of the embedded scene by name; the ball and the box can move."""
_LIGHT_AZIMUTH, _LIGHT_HEIGHT = math.radians(-118.0), math.radians(54.0)


def sun_at(azimuth: float, height: float) -> Colour:
    """Return the unit vector towards the sun at an `azimuth` and a `height` above the horizon, radians."""
    return math.cos(height) * math.cos(azimuth), math.cos(height) * math.sin(azimuth), math.sin(height)


LIGHT = sun_at(_LIGHT_AZIMUTH, _LIGHT_HEIGHT)
"""Unit vector towards the sun."""


class Light(NamedTuple):
    """Light of one image: where the sun stands, and how the camera weighs light.

    Args:
        sun: unit vector towards the sun.
        gains: factors of red, green and blue light before display colours are made of it: exposure and white balance.
    """

    sun: Colour = LIGHT
    gains: Colour = (1.0, 1.0, 1.0)


DAYLIGHT = Light()
"""The light of the embedded scene."""
_SUN, _SKY, _GROUND = (1.55, 1.42, 1.22), (0.46, 0.54, 0.66), (0.30, 0.24, 0.19)
_LIGHT_SPREAD = 0.07  # half width of the penumbra per unit distance


class Hit(NamedTuple):
    """The first surfaces that R rays hit.

    Args:
        depth: (R,) distance along the unit direction in scene units, inf without hit.
        normals: (R, 3) outward unit normals in world axes, zero without hit.
        rgb: (R, 3) display colour in [0, 1], zero without hit.
        hit: (R,) bool, the alpha of a single ray.
        part: (R,) int64 index of the solid, -1 without hit.
    """

    depth: Tensor
    normals: Tensor
    rgb: Tensor
    hit: Tensor
    part: Tensor


class _Pose(NamedTuple):
    """A part with its pose at some time: centre (3, 1 or R), cosine and sine of the yaw (1 or R,)."""

    part: Part
    centre: Tensor
    cosine: Tensor
    sine: Tensor

    def pick(self, index: Tensor) -> _Pose:
        return self if self.cosine.numel() == 1 else _Pose(self.part, *(value[..., index] for value in self[1:]))

    def to_local(self, v: Tensor) -> Tensor:
        return torch.stack([self.cosine * v[0] + self.sine * v[1], self.cosine * v[1] - self.sine * v[0], v[2]])

    def to_world(self, v: Tensor) -> Tensor:
        return torch.stack([self.cosine * v[0] - self.sine * v[1], self.cosine * v[1] + self.sine * v[0], v[2]])


def _poses(time: float | Tensor, like: Tensor, parts: Parts = PARTS) -> list[_Pose]:
    """Return every part with its pose. The ball moves along an arc in two bounces, and the box rotates."""
    t = torch.as_tensor(time, dtype=like.dtype, device=like.device).reshape(-1)
    poses = []
    for name, part in parts.items():
        centre, yaw = like.new_tensor(part.centre)[:, None], like.new_tensor([part.yaw])
        if name == "ball":
            angle = _BALL_ANGLE + math.radians(76.0) * t
            height = part.centre[2] + 0.32 * (2.0 * math.pi * t).sin().abs()
            centre = torch.stack([_BALL_ORBIT * angle.cos(), _BALL_ORBIT * angle.sin(), height])
        elif name == "box":
            yaw = yaw + math.radians(120.0) * t
        poses.append(_Pose(part, centre, yaw.cos(), yaw.sin()))
    return poses


def _lines(pose: _Pose, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Return the rays' points closest to the part's centre, (3, R) relative to it, and their ray parameters (R,)."""
    relative = origins - pose.centre
    nearest = -dot(relative, directions)
    return relative + nearest * directions, nearest


def _first_hits(poses: list[_Pose], origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Return depth (R,) and index of the part (R,) for origins (3, 1 or R) and directions (3, R)."""
    depth = torch.full_like(directions[0], math.inf)
    part_index = torch.full_like(depth, -1, dtype=torch.int64)
    for index, pose in enumerate(poses):
        part, (offset, nearest) = pose.part, _lines(pose, origins, directions)
        near = ((dot(offset, offset) < part.shape.bound**2) & (nearest > -part.shape.bound)).nonzero()[:, 0]
        local, nearest = pose.pick(near), nearest[near]
        offset, direction = local.to_local(offset[:, near]), local.to_local(directions[:, near])
        entry = part.shape.enter(offset, direction, -nearest) + nearest
        better = entry < depth[near]
        depth[near] = torch.where(better, entry, depth[near])
        part_index[near] = torch.where(better, index, part_index[near])
    return depth, part_index


def _distance(poses: list[_Pose], p: Tensor) -> Tensor:
    """Return the signed distance (R,) of points (3, R) to the scene, negative inside a solid."""
    distances = (pose.part.shape.distance(pose.to_local(p - pose.centre)) for pose in poses)
    return functools.reduce(torch.minimum, distances)


def _sunlight(poses: list[_Pose], p: Tensor, sun: Colour) -> Tensor:
    """Return the visible fraction (R,) of the sun at points (3, R), from the distance of the ray to each part."""
    visible = torch.ones_like(p[0])
    light = p.new_tensor(sun)[:, None].expand_as(p)
    for pose in poses:
        part = pose.part
        if not part.shadow:
            continue
        offset, nearest = _lines(pose, p, light)
        reach = part.shape.bound + _LIGHT_SPREAD * nearest.clamp(min=0.0)
        near = ((dot(offset, offset) < reach**2) & (nearest > -part.shape.bound)).nonzero()[:, 0]
        local, nearest = pose.pick(near), nearest[near]
        offset, direction = local.to_local(offset[:, near]), local.to_local(light[:, near])
        for t in part.shape.closest(offset, direction):
            width = _LIGHT_SPREAD * (nearest + t).clamp(min=1e-4)
            share = smoothstep(-1.0, 1.0, part.shape.distance(offset + t * direction) / width)
            share = torch.where(nearest + t > 0.0, share, 1.0)
            visible[near] = torch.minimum(visible[near], share)
    return visible


def _surroundings(d: Tensor) -> Tensor:
    """Return the light (3, R) from unit directions (3, R): a studio sky with two soft lamps over warm ground."""
    sky = blend((0.75, 0.72, 0.68), (0.16, 0.30, 0.52), smoothstep(0.0, 0.9, d[2]))
    light = mix(sky, d.new_tensor(_GROUND)[:, None], smoothstep(0.05, -0.15, d[2]))
    side = d.new_tensor((0.60, 0.62, 0.50))[:, None]
    lamp = smoothstep(0.86, 0.93, dot(d, side)) + smoothstep(0.90, 0.95, d[2])
    return light + 2.2 * lamp


def _shade(
    poses: list[_Pose], p: Tensor, normal: Tensor, view: Tensor, part_index: Tensor, lit: Light = DAYLIGHT
) -> Tensor:
    """Return display colours (3, R) of surface points (3, R) seen along unit `view` directions (3, R)."""
    albedo, gloss = torch.zeros_like(p), torch.zeros_like(p[0])
    for index, pose in enumerate(poses):
        selected = (part_index == index).nonzero()[:, 0]
        local = pose.pick(selected)
        albedo[:, selected] = pose.part.texture(local.to_local(p[:, selected] - local.centre))
        gloss[selected] = pose.part.gloss
    outside = p + 1e-3 * normal
    sun = _sunlight(poses, outside, lit.sun)
    facing = dot(normal, p.new_tensor(lit.sun)[:, None]).clamp(min=0.0)
    # Ambient occlusion: free distance along the normal, relative to that above a plane.
    rooms = [(_distance(poses, p + h * normal) / h).clamp(0.0, 1.0) for h in (0.06, 0.2)]
    room = rooms[0] + rooms[1]
    ambient = blend(_GROUND, _SKY, 0.5 + 0.5 * normal[2]) * (0.15 + 0.425 * room)
    light = albedo * (p.new_tensor(_SUN)[:, None] * (facing * sun) + ambient)

    shiny = (gloss > 0.0).nonzero()[:, 0]
    n, v, g = normal[:, shiny], view[:, shiny], gloss[shiny]
    slope = dot(n, v)
    fresnel = 0.05 + 0.95 * (1.0 + slope).clamp(0.0, 1.0) ** 5
    halfway = p.new_tensor(lit.sun)[:, None] - v
    sparkle = (dot(n, halfway) / dot(halfway, halfway).sqrt()).clamp(min=0.0) ** 90 * sun[shiny]
    mirror = _surroundings(v - 2.0 * slope * n) * fresnel + 1.2 * sparkle
    light[:, shiny] += g * mirror * (0.3 + 0.35 * room[shiny])
    return displayed(light, lit)


def displayed(light: Tensor, lit: Light) -> Tensor:
    """Return the display colours (3, R) of `light` (3, R), as the camera of `lit` weighs it."""
    light = light * light.new_tensor(lit.gains)[:, None]
    return (1.0 - (-1.35 * light).exp()).sqrt()  # compression of highlights, then display gamma


def trace_rows(
    origins: Tensor,
    directions: Tensor,
    time: float | Tensor,
    colour: bool = True,
    parts: Parts = PARTS,
    lit: Light = DAYLIGHT,
) -> Hit:
    """Compute `trace` with vectors stored as rows.

    Args:
        origins: (3, 1 or R).
        directions: (3, R) unit vectors.
        time: in [0, 1], a number or (R,).
        colour: whether to compute colours; otherwise they are zero.
        parts: the solids of the scene.
        lit: the light of the image.

    Returns:
        Same as `trace`, but normals and rgb are (3, R).
    """
    poses = _poses(time, directions, parts)
    depth, part_index = _first_hits(poses, origins, directions)
    normals, rgb = torch.zeros_like(directions), torch.zeros_like(directions)
    rays = (part_index >= 0).nonzero()[:, 0]
    poses = [pose.pick(rays) for pose in poses]
    view, part = directions[:, rays], part_index[rays]
    p = (origins if origins.shape[1] == 1 else origins[:, rays]) + depth[rays] * view
    n = torch.zeros_like(p)
    for index, pose in enumerate(poses):
        selected = (part == index).nonzero()[:, 0]
        local = pose.pick(selected)
        n[:, selected] = local.to_world(pose.part.shape.normal(local.to_local(p[:, selected] - local.centre)))
    normals[:, rays] = n
    if colour:
        rgb[:, rays] = _shade(poses, p, n, view, part, lit)
    return Hit(depth, normals, rgb, part_index >= 0, part_index)


@torch.no_grad()
def trace(origins: Tensor, directions: Tensor, time: float | Tensor = 0.0) -> Hit:
    """Return the first surface along each ray.

    Args:
        origins: (R, 3) outside the solids; a ray that starts inside a solid does not hit that solid.
        directions: (R, 3) unit vectors of the same floating point type. All computations use this type: float64 is
            exact to about 1e-9, float32 to about 1e-5.
        time: in [0, 1], a number or (R,); 0 is the static scene.
    """
    hit = trace_rows(origins.T.contiguous(), directions.T.contiguous(), time)
    return hit._replace(normals=hit.normals.T.contiguous(), rgb=hit.rgb.T.contiguous())


@torch.no_grad()
def inside(points: Tensor, time: float | Tensor = 0.0) -> Tensor:
    """Return whether `points` (N, 3), scene units, lie inside a solid at a `time` in [0, 1] or (N,), as (N,) bool."""
    p = points.T.contiguous()
    return _distance(_poses(time, p), p) < 0.0


@torch.no_grad()
def signed_distance(points: Tensor, time: float | Tensor = 0.0) -> Tensor:
    """Return the distance to the nearest surface, (N,), negative inside a solid; `points` and `time` as in `inside`."""
    p = points.T.contiguous()
    return _distance(_poses(time, p), p)
