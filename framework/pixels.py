"""Batches of training pixels, drawn without building any ray that is not used."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from framework.dataset import Dataset
from framework.rays import Rays

Background = Literal["random", "white", "black"]


@dataclass(frozen=True)
class Batch:
    """R pixels to learn from."""

    rays: Rays
    """R rays through the pixels' centres."""
    rgb: Tensor
    """(R, 3) colours over `background`."""
    background: Tensor
    """(R, 3) what shows where a photograph is transparent."""
    alpha: Tensor | None
    """(R,) opacity, where the photographs have it."""


def background_colors(kind: Background, count: int, device: torch.device) -> Tensor:
    """(count, 3) colours in [0, 1]; "random" draws a new one for each ray, so that no fixed colour can be learnt."""
    if kind == "random":
        return torch.rand(count, 3, device=device)
    return torch.full((count, 3), 1.0 if kind == "white" else 0.0, device=device)


def composite(rgba: Tensor, background: Tensor) -> Tensor:
    """Straight-alpha colours (R, 4) over `background` (R, 3); colours (R, 3) as they are."""
    if rgba.shape[-1] == 3:
        return rgba
    return rgba[..., :3] * rgba[..., 3:] + background * (1 - rgba[..., 3:])


def draw_batch(dataset: Dataset, count: int, background: Background) -> Batch:
    """`count` pixels, each pixel of the set being equally likely, drawn with replacement by torch's generator."""
    device = dataset.pixels.device
    flat = torch.randint(len(dataset.pixels), (count,), device=device)
    images = torch.searchsorted(dataset.offsets, flat, right=True) - 1
    within = flat - dataset.offsets[images]
    widths = dataset.cameras.widths[images]
    scene = dataset.scene
    rays = dataset.cameras.rays(images, within % widths, within // widths, scene.near, scene.far, dataset.times)
    rgba = dataset.pixels[flat].float() / 255
    behind = background_colors(background, count, device)
    alpha = rgba[:, 3] if rgba.shape[-1] == 4 else None
    return Batch(rays, composite(rgba, behind), behind, alpha)
