"""Bodies that move along known paths, and silhouettes of them by closed forms: one image at each time, from above."""

import math
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras
from nerfloom.data.dataset import Dataset
from nerfloom.data.scene import Scene

Capsule = tuple[tuple[float, float, float], tuple[float, float, float], float]
"""Both ends of the axis, and the radius: of a ball the ends are one."""
Motion = Callable[[float], list[Capsule]]
"""Moving bodies, at a time from 0 to 1."""
BOX = torch.tensor([[-1.5] * 3, [1.5] * 3])
STILL: Capsule = ((0.0, 0.0, -0.9), (0.0, 0.0, -0.9), 0.35)
"""A ball that stays, in all images."""


def thrown_ball(speed: float) -> Motion:
    """A ball that rests, is thrown across the box at `speed` box edges for the time from 0 to 1, and rests."""

    def at(time: float) -> list[Capsule]:
        way = min(max((time - 0.4) * 3 * speed / 2, 0), 1)
        place = (2 * way - 1, 0.8 - 0.3 * way, 2.4 * way * (1 - way) - 0.7)
        return [(place, place, 0.15)]

    return at


def swinging_limb(speed: float) -> Motion:
    """A thin limb that turns about its upper end, the other at most at `speed` box edges for the time from 0 to 1."""

    def at(time: float) -> list[Capsule]:
        angle = 1.2 * math.sin(3 * speed / 1.2 * time)
        return [((0.0, 0.0, 0.5), (math.sin(angle), 0.0, 0.5 - math.cos(angle)), 0.08)]

    return at


def jump(speed: float) -> Motion:
    """A body that leaves the ground once, at `speed` box edges for the time from 0 to 1, and throws up its arms."""

    def at(time: float) -> list[Capsule]:
        way = min(max((time - 0.4) * 3 * speed / 2.8, 0), 1)
        height, angle = 2.8 * way * (1 - way) - 0.6, 1.3 * math.sin(math.pi * way) + 0.3
        parts: list[Capsule] = [((0, 0, height - 0.1), (0, 0, height + 0.5), 0.18)]
        for side in (-1, 1):
            hand = (side * (0.2 + 0.6 * math.sin(angle)), 0.0, height + 0.5 - 0.6 * math.cos(angle))
            parts.append(((side * 0.2, 0.0, height + 0.5), hand, 0.06))
        return parts

    return at


def hits(origins: Tensor, directions: Tensor, capsules: list[Capsule]) -> Tensor:
    """Which rays (R,), as lines, pass through a capsule: by the distance between a line and a segment, in float64."""
    found = torch.zeros(len(origins), dtype=torch.bool)
    directions = torch.nn.functional.normalize(directions.double(), dim=-1)
    for first, last, radius in capsules:
        axis = torch.tensor(last).double() - torch.tensor(first).double()
        between = torch.tensor(first).double() - origins.double()
        along, own = directions @ axis, (between * directions).sum(-1)
        share = (along * own - between @ axis) / (axis @ axis - along.square()).clamp(min=1e-12)
        nearest = between + share.clamp(0, 1)[:, None] * axis
        found |= (nearest - (nearest * directions).sum(-1, keepdim=True) * directions).norm(dim=-1) < radius
    return found


def photographed(motion: Motion, count: int, size: int = 100, seed: int = 0) -> tuple[Dataset, Tensor]:
    """`count` images of a moving scene at times from 0 to 1, each from another side from above, and their times."""
    generator = torch.Generator().manual_seed(seed)
    turn, height = torch.rand(2, count, generator=generator)
    turn, height = 2 * math.pi * turn, 0.95 * height + 0.02
    flat = (1 - height.square()).sqrt()
    back = torch.stack([turn.cos() * flat, turn.sin() * flat, height], -1)
    right = torch.stack([-turn.sin(), turn.cos(), torch.zeros(count)], -1)
    poses = torch.stack([right, back.cross(right, dim=-1), back, 4 * back], -1)
    ones, times = torch.ones(count), torch.linspace(0, 1, count)
    sizes = torch.full((count,), size)
    cameras = Cameras(poses, ones * 1.4 * size, ones * 1.4 * size, ones * size / 2, ones * size / 2, sizes, sizes)
    pixels = torch.zeros(count, size * size, 4, dtype=torch.uint8)
    for image, time in enumerate(times.tolist()):
        rays = cameras.pixel_rays(cameras.image_pixels(image), 0.1, 8)
        pixels[image, hits(rays.origins, rays.directions, [*motion(time), STILL])] = 255
    scene = Scene(BOX, 0.1, 8.0, count, True, True, size, num_times=count)
    paths = tuple(Path(f"{image}.png") for image in range(count))
    return Dataset(pixels.view(-1, 4), cameras, times, paths, scene, torch.eye(4)[:3], 1.0), times


def lost(hulls: Tensor, box: Tensor, motion: Motion, points: int = 500, moments: int = 101) -> float:
    """The largest share, over many moments, of positions in moving bodies that are outside the hull of their time.

    Args:
        hulls: (T, n, n, n) bool.
        box: (2, 3) box of the hulls.
        motion: the moving bodies.
        points: number of random positions in each body at each moment.
        moments: number of times, evenly from 0 to 1.
    """
    generator, worst, resolution = torch.Generator().manual_seed(1), 0.0, hulls.shape[1]
    for time in torch.linspace(0, 1, moments).tolist():
        for first, last, radius in motion(time):
            start, axis = torch.tensor(first), torch.tensor(last) - torch.tensor(first)
            around = torch.randn(points, 3, generator=generator)
            around *= radius * torch.rand(points, 1, generator=generator) / around.norm(dim=-1, keepdim=True)
            position = start + torch.rand(points, 1, generator=generator) * axis + around
            unit = (position - box[0]) / (box[1] - box[0])
            x, y, z = (unit * resolution).long().clamp(0, resolution - 1).unbind(-1)
            inside = ((unit >= 0) & (unit < 1)).all(-1)
            kept = hulls[min(int(time * len(hulls)), len(hulls) - 1), x, y, z] & inside
            worst = max(worst, 1 - float(kept.double().mean()))
    return worst
