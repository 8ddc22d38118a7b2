"""Scenes for checks: a ball coloured by its normals and rendered in closed form."""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import normalize

from nerfloom.cameras.cameras import Cameras
from nerfloom.data.dataset import Dataset
from nerfloom.data.scene import Scene
from nerfloom.geometry.rays import Rays
from nerfloom.testing.ball import cameras_at, trace

COUNT, SIZE = 8, 24
"""Number of images, and their default width and height, pixels."""
DISTANCE = 3.0
"""Distance of the cameras from the origin, scene units. The box is [-1, 1]^3."""
FIELD_OF_VIEW = 40.0
"""Angle of view of the cameras, degrees."""
RISE = 0.25
"""Maximum height of the moving ball above and below the origin, scene units."""


def ball_in_a_box(size: int = SIZE) -> Dataset:
    """Return images of a ball at the origin, transparent around it, `size` pixels wide and high."""
    colors, hits = _ball(_rays(size), torch.zeros(3))
    return _dataset(torch.cat([colors, hits[:, None]], dim=-1), size)


def ball_under_a_sky(size: int = SIZE) -> Dataset:
    """Return images of `size` pixels of a ball before a sky at infinity: no alpha, and unbounded."""
    rays = _rays(size)
    colors, hits = _ball(rays, torch.zeros(3))
    return _dataset(torch.where(hits[:, None] > 0, colors, 0.5 + 0.4 * rays.directions), size, unbounded=True)


def moving_ball(size: int = SIZE) -> Dataset:
    """Return images of a ball that rises over time, transparent around it, `size` pixels wide and high."""
    rays, times = _rays(size), torch.linspace(0, 1, COUNT)
    assert rays.camera_indices is not None
    heights = RISE * (2 * times[rays.camera_indices] - 1)
    colors, hits = _ball(rays, heights[:, None] * torch.tensor([0.0, 0.0, 1.0]))
    return _dataset(torch.cat([colors, hits[:, None]], dim=-1), size, times)


def _cameras(size: int) -> Cameras:
    """Return cameras around the origin that look at it, some from above and some from below."""
    angle = torch.arange(COUNT) * (2 * math.pi / COUNT)
    back = normalize(torch.stack([angle.cos(), angle.sin(), 0.5 * (3 * angle).sin()], dim=-1), dim=-1)
    return cameras_at(DISTANCE * back, FIELD_OF_VIEW, size)


def _rays(size: int) -> Rays:
    """Return rays through all pixels of all images."""
    return _cameras(size).pixel_rays(torch.arange(COUNT * size * size), 0.0, 2 * DISTANCE)


def _ball(rays: Rays, centers: Tensor) -> tuple[Tensor, Tensor]:
    """Return colours (R, 3) of balls with centres (R, 3) or (3,), and whether each ray meets its ball (R,), 1 or 0."""
    normals, hits = trace(rays.origins, rays.directions, centers)
    return 0.5 + 0.4 * normals.clamp(-1, 1), hits.float()


def _dataset(colors: Tensor, size: int, times: Tensor | None = None, unbounded: bool = False) -> Dataset:
    """Return a data set of images with colours (P, 3 or 4) in [0, 1]."""
    cameras = _cameras(size)
    scene = Scene(
        box=torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]),
        near=0.05 if unbounded else 1.0,
        far=1000.0 if unbounded else 5.0,
        num_cameras=COUNT,
        has_alpha=colors.shape[1] == 4,
        moving=times is not None,
        image_size=size,
        unbounded=unbounded,
        poses="photographs" if unbounded else "exact",
        camera_to_worlds=cameras.camera_to_worlds,
    )
    return Dataset(
        pixels=(colors * 255).round().to(torch.uint8),
        cameras=cameras,
        times=times,
        paths=tuple(Path(f"{index}.png") for index in range(COUNT)),
        scene=scene,
        transform=torch.eye(4, dtype=torch.float64)[:3],
        scale=1.0,
    )
