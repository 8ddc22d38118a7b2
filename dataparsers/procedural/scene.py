"""The embedded scene: solids with procedural textures under a sun, traced in closed form.

World units are scene units with z up; everything lies strictly inside +-1.4. Depth, normals and occupancy are
exact (limited by the floating point type of the rays), so the scene is also the truth of the accuracy tests.
Colours are display values in [0, 1], as a PNG stores them. Vectors are (3, R) inside this file; the public
functions take and give (R, 3).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dataparsers.procedural.shapes import Box, Cylinder, Shape, Sphere, Torus, dot

Colour = tuple[float, float, float]
_CREAM, _SAND, _SLATE = (0.90, 0.85, 0.74), (0.62, 0.50, 0.35), (0.035, 0.075, 0.115)
_RED, _TEAL, _OCHRE, _BRASS = (0.60, 0.045, 0.05), (0.0, 0.20, 0.24), (0.80, 0.38, 0.045), (0.45, 0.26, 0.08)


def smoothstep(low: float, high: float, x: Tensor) -> Tensor:
    """0 below `low`, 1 above `high`, a cubic between them; falling where high < low."""
    t = ((x - low) / (high - low)).clamp(0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def mix(a: Tensor, b: Tensor, weight: Tensor) -> Tensor:
    """From a (weight 0) to b (weight 1)."""
    return a + (b - a) * weight


def _blend(a: Colour, b: Colour, weight: Tensor) -> Tensor:
    """Colour (3, R) between two colours, weight (R,) in [0, 1]."""
    return torch.stack([x + (y - x) * weight for x, y in zip(a, b, strict=True)])


def _wave(x: Tensor, sharpness: float) -> Tensor:
    """A square wave of period 2 pi with soft flanks, in [-1, 1]."""
    return (x.sin() * sharpness).clamp(-1.0, 1.0)


def _plinth_texture(p: Tensor) -> Tensor:
    """A fine checker floor inside a ring of tick marks, and a fluted rim."""
    radius = (p[0] ** 2 + p[1] ** 2).sqrt()
    angle = torch.atan2(p[1], p[0])
    cells = _wave(p[0] * (math.pi / 0.08), 8.0) * _wave(p[1] * (math.pi / 0.08), 8.0)
    floor = _blend(_CREAM, _SAND, 0.5 + 0.5 * cells)
    ticks = _blend(_SLATE, _CREAM, 0.5 + 0.5 * _wave(angle * 90.0, 3.0))
    band = smoothstep(0.985, 0.995, radius) * (1.0 - smoothstep(1.065, 1.075, radius))
    border = _blend(_SLATE, _TEAL, smoothstep(-0.04, 0.04, p[2]) * (0.5 + 0.5 * _wave(angle * 60.0, 1.5)))
    return mix(mix(floor, border, smoothstep(0.955, 0.965, radius)), ticks, band * (p[2] > 0.0))


def _make_glyphs(cells: int = 3) -> Tensor:
    """Ink (6, 7 cells, 7 cells) of the six box faces: mirrored 5x5 signs like a small unknown alphabet."""
    half = np.random.default_rng(7).random((6, cells, cells, 5, 3)) < 0.55
    signs = np.concatenate([half, half[..., 1::-1]], axis=-1)
    padded = np.pad(signs, ((0, 0), (0, 0), (0, 0), (1, 1), (1, 1)))
    ink = padded.transpose(0, 1, 3, 2, 4).reshape(6, 7 * cells, 7 * cells)
    return torch.from_numpy(ink.astype(np.float32))


_GLYPHS = _make_glyphs()


def _box_texture(p: Tensor, half: float) -> Tensor:
    """Rows of glyphs; between texel centres the ink is interpolated, so it is a continuous function."""
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
    return _blend(_TEAL, _CREAM, value)


def _ring_texture(p: Tensor, major: float) -> Tensor:
    """Stripes that wind around the tube like a twisted rope."""
    along = torch.atan2(p[2], p[0])
    around = torch.atan2(p[1], (p[0] ** 2 + p[2] ** 2).sqrt() - major)
    return _blend(_OCHRE, _CREAM, 0.5 + 0.5 * _wave(16.0 * along + 2.0 * around, 4.0))


def _bob_texture(p: Tensor) -> Tensor:
    """A level set pattern of the gyroid, a smooth labyrinth."""
    x, y, z = p * 60.0
    value = x.sin() * y.cos() + y.sin() * z.cos() + z.sin() * x.cos()
    return _blend(_SLATE, _CREAM, smoothstep(-0.3, 0.3, value))


# ---- The scene ------------------------------------------------------------------------------------------------


class Part(NamedTuple):
    """One solid: `shape` turned by `yaw` (radians, about z) and put at `centre` when time is 0."""

    shape: Shape
    centre: tuple[float, float, float]
    yaw: float
    texture: Callable[[Tensor], Tensor]
    gloss: float  # strength of the mirror-like reflection; 0 is matte, the same colour from everywhere


_TOP = -0.45  # height of the plinth's upper face
_BALL_ORBIT, _BALL_ANGLE = 0.56, math.radians(197.0)
_BALL, _CUBE, _RING = Sphere(0.36), Box(0.26), Torus(0.27, 0.085)
_BALL_CENTRE = (_BALL_ORBIT * math.cos(_BALL_ANGLE), _BALL_ORBIT * math.sin(_BALL_ANGLE), _TOP + _BALL.radius)

PARTS: dict[str, Part] = {
    "plinth": Part(Cylinder(1.15, 0.08), (0.0, 0.0, _TOP - 0.08), 0.0, _plinth_texture, 0.0),
    "ball": Part(_BALL, _BALL_CENTRE, 0.0, lambda p: _blend(_RED, _RED, p[0]), 1.0),
    "box": Part(_CUBE, (0.60, -0.10, _TOP + 0.26), 0.45, lambda p: _box_texture(p, _CUBE.half), 0.0),
    "ring": Part(_RING, (0.08, 0.62, _TOP + 0.355), -0.35, lambda p: _ring_texture(p, _RING.major), 0.0),
    "arch": Part(
        Torus(1.02, 0.018, half=True), (0.0, 0.0, _TOP - 0.08), 2.36, lambda p: _blend(_BRASS, _BRASS, p[0]), 0.4
    ),
    "string": Part(Cylinder(0.015, 0.11), (0.0, 0.0, 0.39), 0.0, lambda p: _blend(_BRASS, _BRASS, p[0]), 0.0),
    "bob": Part(Sphere(0.13), (0.0, 0.0, 0.16), 0.0, _bob_texture, 0.0),
}
_NAMES = tuple(PARTS)
_LIGHT_AZIMUTH, _LIGHT_HEIGHT = math.radians(-118.0), math.radians(54.0)
LIGHT: Colour = (  # unit vector towards the sun
    math.cos(_LIGHT_HEIGHT) * math.cos(_LIGHT_AZIMUTH),
    math.cos(_LIGHT_HEIGHT) * math.sin(_LIGHT_AZIMUTH),
    math.sin(_LIGHT_HEIGHT),
)
_SUN, _SKY, _GROUND = (1.55, 1.42, 1.22), (0.46, 0.54, 0.66), (0.30, 0.24, 0.19)
_LIGHT_SPREAD = 0.07  # half width of the penumbra per unit distance


class Hit(NamedTuple):
    """What R rays meet first.

    depth: (R,) distance along the unit direction in scene units, inf where nothing is hit.
    normals: (R, 3) outward unit normals in world axes, zero where nothing is hit.
    rgb: (R, 3) display colour in [0, 1], zero where nothing is hit.
    hit: (R,) bool, the alpha of a single ray.
    part: (R,) int64 index into `PARTS`, -1 where nothing is hit.
    """

    depth: Tensor
    normals: Tensor
    rgb: Tensor
    hit: Tensor
    part: Tensor


class _Pose(NamedTuple):
    """Where a part is at some time: centre (3, 1 or R), cosine and sine of the yaw (1 or R,)."""

    centre: Tensor
    cosine: Tensor
    sine: Tensor

    def pick(self, index: Tensor) -> _Pose:
        return self if self.cosine.numel() == 1 else _Pose(*(value[..., index] for value in self))

    def to_local(self, v: Tensor) -> Tensor:
        return torch.stack([self.cosine * v[0] + self.sine * v[1], self.cosine * v[1] - self.sine * v[0], v[2]])

    def to_world(self, v: Tensor) -> Tensor:
        return torch.stack([self.cosine * v[0] - self.sine * v[1], self.cosine * v[1] + self.sine * v[0], v[2]])


def _poses(time: float | Tensor, like: Tensor) -> list[_Pose]:
    """Pose of every part. The ball runs along an arc in two bounces and the box turns; the others stand still."""
    t = torch.as_tensor(time, dtype=like.dtype, device=like.device).reshape(-1)
    poses = []
    for name, part in PARTS.items():
        centre, yaw = like.new_tensor(part.centre)[:, None], like.new_tensor([part.yaw])
        if name == "ball":
            angle = _BALL_ANGLE + math.radians(76.0) * t
            height = part.centre[2] + 0.32 * (2.0 * math.pi * t).sin().abs()
            centre = torch.stack([_BALL_ORBIT * angle.cos(), _BALL_ORBIT * angle.sin(), height])
        elif name == "box":
            yaw = yaw + math.radians(120.0) * t
        poses.append(_Pose(centre, yaw.cos(), yaw.sin()))
    return poses


def _lines(pose: _Pose, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """The rays' points nearest to the part's centre, (3, R) from the centre, and their ray parameters (R,)."""
    relative = origins - pose.centre
    nearest = -dot(relative, directions)
    return relative + nearest * directions, nearest


def _first_hits(poses: list[_Pose], origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Depth (R,) and index of the part (R,) of (3, 1 or R) origins and (3, R) directions."""
    depth = torch.full_like(directions[0], math.inf)
    which = torch.full_like(depth, -1, dtype=torch.int64)
    for index, (part, pose) in enumerate(zip(PARTS.values(), poses, strict=True)):
        offset, nearest = _lines(pose, origins, directions)
        near = ((dot(offset, offset) < part.shape.bound**2) & (nearest > -part.shape.bound)).nonzero()[:, 0]
        local, nearest = pose.pick(near), nearest[near]
        offset, direction = local.to_local(offset[:, near]), local.to_local(directions[:, near])
        entry = part.shape.enter(offset, direction, -nearest) + nearest
        better = entry < depth[near]
        depth[near] = torch.where(better, entry, depth[near])
        which[near] = torch.where(better, index, which[near])
    return depth, which


def _distance(poses: list[_Pose], p: Tensor) -> Tensor:
    """Signed distance (R,) of points (3, R) to the scene, negative inside a solid."""
    distances = (
        part.shape.distance(pose.to_local(p - pose.centre)) for part, pose in zip(PARTS.values(), poses, strict=True)
    )
    return functools.reduce(torch.minimum, distances)


def _sunlight(poses: list[_Pose], p: Tensor) -> Tensor:
    """Visible fraction (R,) of the sun from points (3, R): soft, from how near the light ray passes each part."""
    visible = torch.ones_like(p[0])
    light = p.new_tensor(LIGHT)[:, None].expand_as(p)
    for (name, part), pose in zip(PARTS.items(), poses, strict=True):
        if name == "plinth":  # everything else stands on it and the light comes from above
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
    """Light (3, R) that arrives from unit directions (3, R): a studio sky with two soft lamps over warm ground."""
    sky = _blend((0.75, 0.72, 0.68), (0.16, 0.30, 0.52), smoothstep(0.0, 0.9, d[2]))
    light = mix(sky, d.new_tensor(_GROUND)[:, None], smoothstep(0.05, -0.15, d[2]))
    side = d.new_tensor((0.60, 0.62, 0.50))[:, None]
    lamp = smoothstep(0.86, 0.93, dot(d, side)) + smoothstep(0.90, 0.95, d[2])
    return light + 2.2 * lamp


def _shade(poses: list[_Pose], p: Tensor, normal: Tensor, view: Tensor, which: Tensor) -> Tensor:
    """Display colour (3, R) of surface points (3, R) seen along unit `view` directions (3, R)."""
    albedo, gloss = torch.zeros_like(p), torch.zeros_like(p[0])
    for index, (part, pose) in enumerate(zip(PARTS.values(), poses, strict=True)):
        mine = (which == index).nonzero()[:, 0]
        local = pose.pick(mine)
        albedo[:, mine] = part.texture(local.to_local(p[:, mine] - local.centre))
        gloss[mine] = part.gloss
    outside = p + 1e-3 * normal
    sun = _sunlight(poses, outside)
    facing = dot(normal, p.new_tensor(LIGHT)[:, None]).clamp(min=0.0)
    # Ambient occlusion: how much less room there is along the normal than over an open plane.
    rooms = [(_distance(poses, p + h * normal) / h).clamp(0.0, 1.0) for h in (0.06, 0.2)]
    room = rooms[0] + rooms[1]
    ambient = _blend(_GROUND, _SKY, 0.5 + 0.5 * normal[2]) * (0.15 + 0.425 * room)
    light = albedo * (p.new_tensor(_SUN)[:, None] * (facing * sun) + ambient)

    shiny = (gloss > 0.0).nonzero()[:, 0]
    n, v, g = normal[:, shiny], view[:, shiny], gloss[shiny]
    slope = dot(n, v)
    fresnel = 0.05 + 0.95 * (1.0 + slope).clamp(0.0, 1.0) ** 5
    halfway = p.new_tensor(LIGHT)[:, None] - v
    sparkle = (dot(n, halfway) / dot(halfway, halfway).sqrt()).clamp(min=0.0) ** 90 * sun[shiny]
    mirror = _surroundings(v - 2.0 * slope * n) * fresnel + 1.2 * sparkle
    light[:, shiny] += g * mirror * (0.3 + 0.35 * room[shiny])
    return (1.0 - (-1.35 * light).exp()).sqrt()  # a soft shoulder, then display gamma


def trace_rows(origins: Tensor, directions: Tensor, time: float | Tensor, colour: bool = True) -> Hit:
    """`trace` on rows: origins (3, 1 or R), directions (3, R); normals and rgb come out as (3, R)."""
    poses = _poses(time, directions)
    depth, which = _first_hits(poses, origins, directions)
    normals, rgb = torch.zeros_like(directions), torch.zeros_like(directions)
    found = (which >= 0).nonzero()[:, 0]
    poses = [pose.pick(found) for pose in poses]
    view, part = directions[:, found], which[found]
    p = (origins if origins.shape[1] == 1 else origins[:, found]) + depth[found] * view
    n = torch.zeros_like(p)
    for index, (solid, pose) in enumerate(zip(PARTS.values(), poses, strict=True)):
        mine = (part == index).nonzero()[:, 0]
        local = pose.pick(mine)
        n[:, mine] = local.to_world(solid.shape.normal(local.to_local(p[:, mine] - local.centre)))
    normals[:, found] = n
    if colour:
        rgb[:, found] = _shade(poses, p, n, view, part)
    return Hit(depth, normals, rgb, which >= 0, which)


@torch.no_grad()
def trace(origins: Tensor, directions: Tensor, time: float | Tensor = 0.0) -> Hit:
    """First surface along rays.

    origins: (R, 3) outside of the solids (a ray that starts inside a solid does not see that solid).
    directions: (R, 3) unit vectors of the same floating point type, which is the type of the computation:
        float64 is exact to about 1e-9, float32 to about 1e-5.
    time: in [0, 1], one number or (R,); 0 is the static scene.
    """
    hit = trace_rows(origins.T.contiguous(), directions.T.contiguous(), time)
    return hit._replace(normals=hit.normals.T.contiguous(), rgb=hit.rgb.T.contiguous())


@torch.no_grad()
def inside(points: Tensor, time: float | Tensor = 0.0) -> Tensor:
    """Whether points (N, 3) in scene units lie inside a solid at `time` (a number or (N,)): (N,) bool."""
    p = points.T.contiguous()
    return _distance(_poses(time, p), p) < 0.0
