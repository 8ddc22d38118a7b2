"""Export of a point cloud: the points at the median depth of the training cameras' rays."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nerfloom.base.console import track
from nerfloom.base.evenly_spaced import evenly_spread
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.batch import draw_pixels
from nerfloom.geometry.records import TensorRows
from nerfloom.renderable import Renderable, RendersRays
from nerfloom.rendering.outputs import NORMALS

OPAQUE = 0.5
"""Minimum opacity of a ray that ends on a surface."""
MAX_PASSES = 32
"""Maximum number of times that rays are drawn, since some end on no surface."""
MAX_VIEWS = 200
"""Maximum number of views that are rendered of a method that casts no rays."""


@dataclass(frozen=True)
class SurfacePoints(TensorRows):
    """K points on surfaces, scene coordinates."""

    positions: Tensor
    """(K, 3) positions."""
    colors: Tensor
    """(K, 3) colours in [0, 1], as seen from the respective camera, in the mean light of the images."""
    normals: Tensor | None
    """(K, 3) unit normals, if the method has them."""
    directions: Tensor
    """(K, 3) unit directions of the rays that ended there."""
    pixels: Tensor
    """(K,) int64 numbers of their pixels, counted through all images."""


@torch.no_grad()
def surface_points(model: RendersRays, dataset: Dataset, count: int, reach: float | None) -> Iterator[SurfacePoints]:
    """Return surface points at the median depth of random training pixels, chunk by chunk.

    There are fewer than `count` points if some rays do not end on a surface.

    Args:
        model: the model in evaluation mode.
        dataset: the training split, on the model's device.
        count: number of rays.
        reach: maximum distance of a point from the box's centre along each axis, in half edges of the box; None keeps
            all points.
    """
    background, scene = model.background, model.scene
    chunk = model.rays_at_once
    for start in range(0, count, chunk):
        pixels = draw_pixels(dataset, min(chunk, count - start)).to(model.device)
        rays = dataset.cameras.pixel_rays(pixels, scene.near, scene.far, dataset.times)
        with model.rendering():
            out = model.render(replace(rays, camera_indices=None), background)
        depth = out.median_depth.float()
        positions = rays.origins + depth[:, None] * rays.directions
        selected = (out.accumulation >= OPAQUE) & (depth < rays.fars) & _within(model, positions, reach)
        normals = out.extras.get(NORMALS.name)
        normals = None if normals is None else NORMALS.finished(normals)[selected].cpu()
        yield SurfacePoints(
            positions[selected].cpu(),
            out.rgb.float().clamp(0, 1)[selected].cpu(),
            normals,
            rays.directions[selected].cpu(),
            pixels[selected].cpu(),
        )


def several_passes(model: RendersRays, dataset: Dataset, count: int) -> SurfacePoints:
    """Return at most `count` surface points of random training pixels.

    Each pass draws as many rays as points are missing, because rendering them can take longer than training a field.

    Args:
        model, dataset: as in `surface_points`.
        count: number of points, at least 1.
    """
    found, left, passes = list[SurfacePoints](), count, MAX_PASSES
    for percent in track(range(100), "Looking for surfaces", total=100):
        while passes and count - left < count * (percent + 1) / 100:
            found.append(joined(surface_points(model, dataset, left, None)))
            drawn = len(found[-1].positions)
            left, passes = left - drawn, passes - 1 if drawn else 0
    return joined(iter(found))


@torch.no_grad()
def picture_points(model: Renderable, dataset: Dataset, count: int, reach: float | None) -> Iterator[SurfacePoints]:
    """Return surface points at the median depth of random pixels of rendered training views, view by view.

    It is for methods that cast no rays; views are evenly spaced in the data set, at most `MAX_VIEWS`.

    Args:
        model: the model in evaluation mode.
        dataset: the training split, on the model's device.
        count: number of pixels.
        reach: as in `surface_points`.
    """
    background, far = model.background, model.scene.far
    views = evenly_spread(len(dataset), MAX_VIEWS)
    for number, index in enumerate(views):
        view = replace(dataset.view(index), image=None)
        picture = model.render_view(view, background)
        drawn = (number + 1) * count // len(views) - number * count // len(views)
        pixels = torch.randint(picture.depth.numel(), (drawn,), device=model.device)
        rays = view.camera.pixel_rays(pixels, model.scene.near, far)
        depth = picture.median_depth.reshape(-1)[pixels]
        places = rays.origins + depth[:, None] * rays.directions
        opaque = picture.accumulation.reshape(-1)[pixels] >= OPAQUE
        selected = opaque & (depth < rays.fars) & _within(model, places, reach)
        if (kept := dataset.kept_of(index)) is not None:
            selected &= kept.to(model.device).reshape(-1)[pixels]
        normals = picture.extras.get(NORMALS.name)
        normals = None if normals is None else normals.reshape(-1, 3)[pixels][selected].cpu()
        yield SurfacePoints(
            places[selected].cpu(),
            picture.rgb.clamp(0, 1).reshape(-1, 3)[pixels][selected].cpu(),
            normals,
            rays.directions[selected].cpu(),
            (dataset.cameras.ends[index] + pixels[selected]).cpu(),
        )


def num_views(dataset: Dataset) -> int:
    """Return the number of views of `dataset` that `picture_points` renders."""
    return min(len(dataset), MAX_VIEWS)


def _within(model: Renderable, positions: Tensor, reach: float | None) -> Tensor:
    """Return which positions (N, 3) are finite and within `reach`, (N,) bool."""
    selected = positions.isfinite().all(-1)
    if reach is not None:
        box = model.scene.box.to(model.device)
        selected &= ((positions - box.mean(0)).abs() <= reach * (box[1] - box[0]) / 2).all(-1)
    return selected


def joined(parts: Iterable[SurfacePoints]) -> SurfacePoints:
    """Concatenate one or more `parts`; without normals if any part has none."""
    chunks = list(parts)
    normals = [chunk.normals for chunk in chunks if chunk.normals is not None]
    return SurfacePoints(
        torch.cat([chunk.positions for chunk in chunks]),
        torch.cat([chunk.colors for chunk in chunks]),
        torch.cat(normals) if len(normals) == len(chunks) else None,
        torch.cat([chunk.directions for chunk in chunks]),
        torch.cat([chunk.pixels for chunk in chunks]),
    )
