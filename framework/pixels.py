"""Batches of training pixels, drawn without building any ray that is not used."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from framework.dataset import Dataset
from framework.error_map import ErrorMap
from framework.kernels import native
from framework.rays import Rays

Background = Literal["random", "white", "black"]


@dataclass(frozen=True)
class Batch:
    """R pixels to learn from."""

    pixels: Tensor
    """(R,) int64 which they are, counted through all images."""
    rays: Rays
    """R rays through the pixels' centres."""
    rgb: Tensor
    """(R, 3) colours over `background`."""
    background: Tensor
    """(R, 3) what shows where a photograph is transparent."""
    alpha: Tensor | None
    """(R,) opacity, where the photographs have it."""
    weights: Tensor | None = None
    """(R,) what each pixel's loss is multiplied by, where they were not drawn evenly; 1 in the mean."""


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


_draw = native.function("draw_pinhole", "pqpqpppppp" + "pipppppppi")


def draw_pixels(dataset: Dataset, count: int) -> Tensor:
    """`count` pixels, each of those worth drawing being equally likely, with replacement, by torch's generator."""
    device = dataset.pixels.device
    if dataset.drawn is None:
        return torch.randint(len(dataset.pixels), (count,), device=device)
    return dataset.drawn[torch.randint(len(dataset.drawn), (count,), device=device)]


def draw_batch(dataset: Dataset, count: int, background: Background, errors: ErrorMap | None = None) -> Batch:
    """`count` pixels worth drawing with what they should show: evenly, or also where `errors` are large."""
    behind = background_colors(background, count, dataset.pixels.device)
    if errors is None:
        return gather_batch(dataset, draw_pixels(dataset, count), behind)
    flat, weights = errors.draw(draw_pixels(dataset, 2 * count), count)
    return replace(gather_batch(dataset, flat, behind), weights=weights)


def gather_batch(dataset: Dataset, flat: Tensor, behind: Tensor) -> Batch:
    """The pixels `flat` (R,), counted through all images, over the background `behind` (R, 3)."""
    cameras = dataset.cameras
    if cameras.model == "pinhole" and native.usable(cameras.camera_to_worlds, behind):
        return _gather_compiled(dataset, flat, behind)
    return gather_batch_reference(dataset, flat, behind)


def gather_batch_reference(dataset: Dataset, flat: Tensor, behind: Tensor) -> Batch:
    """As `gather_batch`, in torch, for any camera and device."""
    images = torch.searchsorted(dataset.offsets, flat, right=True) - 1
    within = flat - dataset.offsets[images]
    widths = dataset.cameras.widths[images]
    scene = dataset.scene
    rays = dataset.cameras.rays(images, within % widths, within // widths, scene.near, scene.far, dataset.times)
    rgba = dataset.pixels[flat].float() / 255
    alpha = rgba[:, 3] if rgba.shape[-1] == 4 else None
    return Batch(flat, rays, composite(rgba, behind), behind, alpha)


def _gather_compiled(dataset: Dataset, flat: Tensor, behind: Tensor) -> Batch:
    cameras, scene, count, images = dataset.cameras, dataset.scene, len(flat), len(dataset)
    channels = dataset.pixels.shape[1]
    origins, directions, rgb = (torch.empty(count, 3) for _ in range(3))
    radii, alpha, indices = torch.empty(count), torch.empty(count), torch.empty(count, dtype=torch.int64)
    poses, widths = cameras.camera_to_worlds.contiguous(), cameras.widths.contiguous()
    numbers = {name: getattr(cameras, name).contiguous() for name in ("fx", "fy", "cx", "cy")}
    intrinsics = [native.pointer(values, name, (images,)) for name, values in numbers.items()]
    _draw(
        native.pointer(flat, "pixel indices", (count,), torch.int64), count,
        native.pointer(dataset.offsets, "offsets", (images + 1,), torch.int64), images,
        native.pointer(widths, "widths", (images,), torch.int64),
        native.pointer(poses, "poses", (images, 3, 4)), *intrinsics,
        native.pointer(dataset.pixels, "pixels", (len(dataset.pixels), channels), torch.uint8), channels,
        native.pointer(behind, "the background", (count, 3)), origins.data_ptr(), directions.data_ptr(),
        radii.data_ptr(), indices.data_ptr(), rgb.data_ptr(), alpha.data_ptr(), native.threads(),
    )  # fmt: skip
    rays = Rays(
        origins,
        directions,
        torch.full((count,), scene.near),
        torch.full((count,), scene.far),
        radii,
        None if dataset.times is None else dataset.times[indices],
        indices,
    )
    return Batch(flat, rays, rgb, behind, alpha if channels == 4 else None)
