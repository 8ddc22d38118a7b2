"""Sightings of Gaussians: their weight in the pixels of photographs, and whether they float in front of surfaces."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nerfloom.base.console import track
from nerfloom.base.evenly_spaced import strided
from nerfloom.kernels.splats.project import Record, SplatCamera
from nerfloom.splats.drawing import smallest_depth, splat_camera
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import Look
from nerfloom.splats.rasteriser import RASTERISER, Projected
from nerfloom.training.loaded import Loaded

MAX_VIEWS = 200
"""Maximum number of training images that are looked at, evenly spaced."""
MAX_SIDE = 800
"""Maximum side of these images, pixels; larger ones are reduced by an integer factor."""
CLEAR_SHARE = 0.9
"""A Gaussian is in front of a surface below this fraction of its distance, and behind it above the inverse."""


@dataclass(frozen=True)
class Sightings:
    """Sightings of N Gaussians in V images."""

    weights: Tensor
    """(N,) float64 sum of its blending weights over all pixels of all images."""
    views: Tensor
    """(N,) float64 number of images that show its centre, in front of a surface or on it."""
    in_front: Tensor
    """(N,) float64 number of these that show it clearly in front of the surface, or where there is none."""
    opacity_in_front: Tensor
    """(N,) float64 mean weight on its area, in those images: its opacity as they see it, 0 to 1; 0 without any."""


def training_views(loaded: Loaded, look: Look, most: int = MAX_VIEWS) -> list[SplatCamera]:
    """Return the cameras of training images, in their reduced sizes. The images are not decoded.

    Args:
        loaded: a run, or a file with data.
        look: the settings of drawing.
        most: maximum number of cameras, evenly spaced.

    Raises:
        ConfigError: if Gaussians cannot be drawn for such cameras.
        DataError: if the data cannot be read.
    """
    scene, parsed = loaded.model.scene, loaded.parsed("train")
    cameras = parsed.cameras.scaled(1 / parsed.downscale_factor).to(loaded.model.device)
    found = []
    for index in strided(len(cameras), most):
        reduced = -(-max(cameras.sizes[index]) // MAX_SIDE)
        found.append(splat_camera(cameras[index : index + 1], smallest_depth(scene), look, reduced=reduced))
    return found


def sightings(gaussians: Gaussians, views: Sequence[SplatCamera]) -> Sightings:
    """Look at Gaussians from cameras.

    A pixel is the sum of weights times colours, so the sum of a Gaussian's weights is the derivative of the sum of all
    pixels by its colour. The surface is at the median depth, where transmittance falls to 1/2.

    Args:
        gaussians: N Gaussians, float32, in the frame of the cameras.
        views: V cameras.
    """
    weights, shown_in, in_front, weights_there, areas_there = torch.zeros(
        5, len(gaussians), dtype=torch.float64, device=gaussians.means.device
    )
    for camera in track(views, "Looking from the photographs", total=len(views)):
        with torch.no_grad():
            shown = RASTERISER.project(gaussians, camera)
        if not bool((shown.records[:, Record.CUT] > 0).any()):
            continue
        records, by_view, median = _drawn(shown, camera)
        weights += by_view
        x, y, distances = records[:, Record.X], records[:, Record.Y], records[:, Record.DISTANCE]
        inside = (records[:, Record.CUT] > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
        columns, rows = x.long().clamp(0, camera.width - 1), y.long().clamp(0, camera.height - 1)
        surface = torch.where(median > 0, median, math.inf)[rows, columns]
        ahead = inside & (distances < CLEAR_SHARE * surface)
        shown_in += inside & (CLEAR_SHARE * distances <= surface)
        in_front += ahead
        # The integral of exp(-u^2 - v^2) over the image.
        areas = math.pi / (records[:, Record.U_X] * records[:, Record.V_Y]).clamp(min=1e-12)
        weights_there += torch.where(ahead, by_view, 0)
        areas_there += torch.where(ahead, areas, 0)
    return Sightings(weights, shown_in, in_front, weights_there / areas_there.clamp(min=1e-12))


def _drawn(shown: Projected, camera: SplatCamera) -> tuple[Tensor, Tensor, Tensor]:
    """Return N records on an image, the sum (N,) of each one's weights, and the median distance (H, W)."""
    with torch.enable_grad():
        records = shown.records.detach().requires_grad_()
        background = torch.zeros(3, device=records.device)
        blended = RASTERISER.draw(shown._replace(records=records), camera, background, median=True)
        (gradient,) = torch.autograd.grad(blended.image[..., 0].sum(), records)
    assert blended.median is not None
    return records.detach(), gradient[:, Record.RED], blended.median
