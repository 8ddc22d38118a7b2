"""Batches of training pixels, drawn without building any ray that is not used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from framework.cameras.cameras import CENTER
from framework.data.dataset import Dataset
from framework.data.depths import ray_distances
from framework.data.error_map import ErrorMap
from framework.geometry.rays import Rays
from framework.kernels import native
from framework.kernels.dispatch import CPP, Operation
from framework.kernels.given import check_indices

Background = Literal["random", "white", "black"]
LookUp = Callable[[Tensor], Tensor]
"""From pixels (R,) int64 to their stored colours (R, 3 or 4) uint8."""


@dataclass(frozen=True)
class Batch:
    """R pixels to learn from."""

    pixels: Tensor
    """(R,) int64 which they are, counted through all images."""
    rays: Rays
    """R * K rays, those of a pixel together; through its centre where K is 1."""
    rgb: Tensor
    """(R, 3) colours over `background`."""
    background: Tensor
    """(R, 3) what shows where a photograph is transparent."""
    alpha: Tensor | None
    """(R,) opacity, where the photographs have it."""
    distances: Tensor | None = None
    """(R,) along the pixel's ray to what a depth image shows, 0 where unknown, where there are such images."""
    weights: Tensor | None = None
    """(R,) what each pixel's loss is multiplied by, where they were not drawn evenly; 1 in the mean."""


def training_background(asked: Background | Literal["auto"], has_alpha: bool) -> Background:
    """What is behind transparent pixels in training: as asked for; of "auto", random where photographs have alpha."""
    if asked != "auto":
        return asked
    return "random" if has_alpha else "black"


def background_colors(kind: Background, count: int, device: torch.device) -> Tensor:
    """(count, 3) colours in [0, 1]; "random" draws a new one for each pixel, so that no fixed colour can be learnt."""
    if kind == "random":
        return torch.rand(count, 3, device=device)
    return torch.full((count, 3), 1.0 if kind == "white" else 0.0, device=device)


def composite(rgba: Tensor, background: Tensor) -> Tensor:
    """Straight-alpha colours (R, 4) over `background` (R, 3); colours (R, 3) as they are."""
    if rgba.shape[-1] == 3:
        return rgba
    return rgba[..., :3] * rgba[..., 3:] + background * (1 - rgba[..., 3:])


def draw_pixels(dataset: Dataset, count: int) -> Tensor:
    """`count` pixels, each of those worth drawing being equally likely, with replacement, by torch's generator."""
    device = dataset.pixels.device
    if dataset.drawn is None:
        return torch.randint(len(dataset.pixels), (count,), device=device)
    return dataset.drawn.at(torch.randint(len(dataset.drawn), (count,), device=device))


def draw_batch(
    dataset: Dataset,
    count: int,
    background: Background,
    errors: ErrorMap | None = None,
    places: Tensor = CENTER,
    look_up: LookUp | None = None,
) -> Batch:
    """`count` pixels worth drawing with what they should show: evenly, or also where `errors` are large.

    A ray goes through each of the `places` (K, 2) in a pixel (`Cameras.pixel_rays`). Pixels that lie in a file are
    asked for by `look_up`, all that are drawn and in the order of drawing (`PixelStream.look_up`).
    """
    # Drawn before anything else is: what is drawn from is then known to who only knows the seed.
    flat, stored = draw_pixels(dataset, count if errors is None else 2 * count), None
    if dataset.mapped is not None:
        stored = (look_up or dataset.mapped.look_up)(flat).to(dataset.device)
        flat = flat.to(dataset.device)
    behind = background_colors(background, count, dataset.device)
    if errors is None:
        return gather_batch(dataset, flat, behind, places, stored)
    taken, weights = errors.choose(flat, count)
    stored = None if stored is None else stored[taken]
    return replace(gather_batch(dataset, flat[taken], behind, places, stored), weights=weights)


def gather_batch(
    dataset: Dataset, flat: Tensor, behind: Tensor, places: Tensor = CENTER, stored: Tensor | None = None
) -> Batch:
    """The pixels `flat` (R,), counted through all images, over the background `behind` (R, 3).

    Their stored colours (R, 3 or 4) are looked up where `stored` does not give them.
    """
    scene = dataset.scene
    rays = dataset.cameras.pixel_rays(flat, scene.near, scene.far, dataset.times, places)
    if stored is None and dataset.mapped is not None:
        stored = dataset.mapped.look_up(flat.cpu()).to(dataset.device)
    if stored is None:
        rgb, alpha = gather_colors(dataset.pixels, flat, behind)
    else:
        rgb, alpha = gather_colors(stored, torch.arange(len(flat), device=flat.device), behind)
    if dataset.opaque is not None:
        shown = dataset.opaque.contains(flat)
        rgb, alpha = torch.where(shown[:, None], rgb, behind), shown * (1.0 if alpha is None else alpha)
    return Batch(flat, rays, rgb, behind, alpha, _distances(dataset, flat, rays))


def _distances(dataset: Dataset, flat: Tensor, rays: Rays) -> Tensor | None:
    if dataset.depths is None or rays.camera_indices is None:
        return None
    per_pixel = len(rays) // max(len(flat), 1)
    cameras = rays.camera_indices[::per_pixel] if len(flat) else rays.camera_indices
    directions = rays.directions.view(len(flat), per_pixel, 3).mean(1)
    poses = dataset.cameras.camera_to_worlds[cameras]
    return ray_distances(dataset.depths[flat], torch.nn.functional.normalize(directions, dim=-1), poses)


def gather_colors_reference(pixels: Tensor, flat: Tensor, behind: Tensor) -> tuple[Tensor, Tensor | None]:
    """As `gather_colors`, in torch, on any device."""
    check_indices(flat, len(pixels), "pixels")
    rgba = pixels[flat].float() / 255
    return composite(rgba, behind), rgba[:, 3] if rgba.shape[-1] == 4 else None


def gather_colors(pixels: Tensor, flat: Tensor, behind: Tensor) -> tuple[Tensor, Tensor | None]:
    """Colours (R, 3) of the pixels `flat` (R,) over `behind` (R, 3), and opacities (R,) where there are any.

    `pixels` (P, 3 or 4) are uint8, straight alpha.

    Raises: IndexError where there is no such pixel.
    """
    return GATHER_COLORS((behind,), pixels, flat, behind)


GATHER_COLORS = Operation("gather_colors", gather_colors_reference)


@GATHER_COLORS.implementation(CPP, order=0)
def _compiled(pixels: Tensor, flat: Tensor, behind: Tensor) -> tuple[Tensor, Tensor | None]:
    count, channels = len(flat), pixels.shape[1]
    rgb, alpha = torch.empty(count, 3), torch.empty(count)
    _gather_colors(
        native.pointer(flat, "pixel indices", (count,), torch.int64), count,
        native.pointer(pixels, "pixels", (len(pixels), channels), torch.uint8), len(pixels), channels,
        native.pointer(behind, "the background", (count, 3)), rgb.data_ptr(), alpha.data_ptr(), native.threads(),
    )  # fmt: skip
    return rgb, alpha if channels == 4 else None


_gather_colors = native.Function("gather_colors", "pqpqipppi")
