"""Scenes for checks: a ball whose colour tells where its surface faces, traced in closed form."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

from framework.cameras.cameras import Cameras
from framework.data.dataset import Dataset
from framework.data.scene import Scene
from framework.geometry.rays import Rays
from framework.tools.testing.ball import cameras_at, trace

COUNT, SIZE = 8, 24
"""Photographs, and their width and height, pixels."""
DISTANCE = 3.0
"""Of the cameras from the origin, scene units. The box reaches from -1 to 1."""
FIELD_OF_VIEW = 40.0
"""Degrees."""
RISE = 0.25
"""How far up and down the ball goes that moves, scene units."""


def ball_in_a_box() -> Dataset:
    """A ball at the origin; what is around it is transparent."""
    colors, shown = _ball(_rays(), torch.zeros(3))
    return _dataset(torch.cat([colors, shown[:, None]], dim=-1))


def ball_under_a_sky() -> Dataset:
    """The same in front of a sky that is infinitely far away: photographs without alpha, a scene without end."""
    rays = _rays()
    colors, shown = _ball(rays, torch.zeros(3))
    return _dataset(torch.where(shown[:, None] > 0, colors, 0.5 + 0.4 * rays.directions), unbounded=True)


def moving_ball() -> Dataset:
    """A ball that rises from photograph to photograph; what is around it is transparent."""
    rays, times = _rays(), torch.linspace(0, 1, COUNT)
    assert rays.camera_indices is not None
    heights = RISE * (2 * times[rays.camera_indices] - 1)
    colors, shown = _ball(rays, heights[:, None] * torch.tensor([0.0, 0.0, 1.0]))
    return _dataset(torch.cat([colors, shown[:, None]], dim=-1), times)


def _cameras() -> Cameras:
    """Around the origin and looking at it, some from above and some from below."""
    turn = torch.arange(COUNT) * (2 * math.pi / COUNT)
    back = normalize(torch.stack([turn.cos(), turn.sin(), 0.5 * (3 * turn).sin()], dim=-1), dim=-1)
    return cameras_at(DISTANCE * back, FIELD_OF_VIEW, SIZE)


def _rays() -> Rays:
    """Through every pixel of every photograph."""
    return _cameras().pixel_rays(torch.arange(COUNT * SIZE * SIZE), 0.0, 2 * DISTANCE)


def _ball(rays: Rays, centers: Tensor) -> tuple[Tensor, Tensor]:
    """Colours (R, 3) of balls around `centers`, (R, 3) or (3,), and 1 where (R,) a ray meets its ball, else 0."""
    normals, hits = trace(rays.origins, rays.directions, centers)
    return 0.5 + 0.4 * normals.clamp(-1, 1), hits.float()


def _dataset(colors: Tensor, times: Tensor | None = None, unbounded: bool = False) -> Dataset:
    """Photographs with colours (P, 3 or 4) in [0, 1]."""
    cameras = _cameras()
    scene = Scene(
        box=torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]),
        near=0.05 if unbounded else 1.0,
        far=1000.0 if unbounded else 5.0,
        num_cameras=COUNT,
        has_alpha=colors.shape[1] == 4,
        moving=times is not None,
        image_size=SIZE,
        unbounded=unbounded,
        poses="photographs" if unbounded else "exact",
        camera_to_worlds=cameras.camera_to_worlds,
    )
    return Dataset(
        pixels=(colors * 255).round().to(torch.uint8),
        cameras=cameras,
        times=times,
        names=tuple(f"{index}.png" for index in range(COUNT)),
        scene=scene,
        transform=torch.eye(4)[:3],
        scale=1.0,
    )
