"""Scenes as plain functions of positions, and a plain quadrature of their colours."""

from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.closed_forms import BOX, ClosedForm, scenes
from nerfloom import Rays
from nerfloom.geometry.points import Points

BACKGROUND = torch.tensor([0.2, 0.5, 1.0])


def functions(scene: str | ClosedForm) -> tuple[Callable[..., Tensor], Callable[..., tuple[Tensor, Tensor]]]:
    """`sigma_fn` and `rgb_sigma_fn` of a scene in closed form."""
    field = scenes()[scene] if isinstance(scene, str) else scene

    def rgb_sigma(positions: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        sigma, rgb = field.density(Points(positions))
        return rgb, sigma

    return lambda positions: field.density(Points(positions))[0], rgb_sigma


def steps_through_box(rays: Rays, step: float) -> tuple[Tensor, Tensor]:
    """Middles (R, S) float64 of all even steps from where rays enter `BOX`, and which of them are in it."""
    origins, directions, box = rays.origins.double(), rays.directions.double(), BOX.double()
    sides = torch.stack([(corner - origins) / directions for corner in box])
    enter, leave = sides.amin(0).amax(-1).clamp(min=0), sides.amax(0).amin(-1)
    t = enter[:, None] + (torch.arange(int(3.5 / step)) + 0.5) * step
    return t, t < leave[:, None]


def dense_quadrature(rays: Rays, rgb_sigma: Callable, step: float) -> Tensor:
    """(R, 3) float64 over `BACKGROUND`: every step through the box, by the product of the transmittances."""
    t, inside = steps_through_box(rays, step)
    positions = rays.origins.double()[:, None] + t[..., None] * rays.directions.double()[:, None]
    directions = rays.directions.double()[:, None].expand_as(positions)
    rgb, sigma = rgb_sigma(positions.view(-1, 3), directions.reshape(-1, 3))
    alpha = (1 - torch.exp(-sigma.view(t.shape) * step)) * inside
    color, left = torch.zeros(len(t), 3, dtype=torch.float64), torch.ones(len(t), dtype=torch.float64)
    for n in range(t.shape[1]):
        color = color + (left * alpha[:, n])[:, None] * rgb.view(*t.shape, 3)[:, n]
        left = left * (1 - alpha[:, n])
    return color + left[:, None] * BACKGROUND.double()
