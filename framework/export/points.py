"""Export of a point cloud of what the training cameras see, at the median depth of each ray."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from framework.data.dataset import Dataset
from framework.data.pixels import draw_pixels
from framework.evaluation.evaluator import evaluation_background
from framework.kernels.math import safe_normalize
from framework.ray_model import RayModel

OPAQUE = 0.5
"""Minimum opacity of a ray that ends on a surface."""


@dataclass(frozen=True)
class SurfacePoints:
    """K points on surfaces, scene coordinates."""

    positions: Tensor
    """(K, 3) positions."""
    colors: Tensor
    """(K, 3) colours in [0, 1], as seen from the respective camera."""
    normals: Tensor | None
    """(K, 3) unit normals, if the method has them."""


@torch.no_grad()
def surface_points(model: RayModel[Any], dataset: Dataset, count: int, reach: float | None) -> Iterator[SurfacePoints]:
    """Return surface points at the median depth of random training pixels, chunk by chunk.

    There are fewer than `count` points if some rays do not end on a surface.

    Args:
        model: the model in evaluation mode.
        dataset: the training split, on the model's device.
        count: number of rays.
        reach: maximum distance of a point from the box's centre along each axis, in half edges of the box; None keeps
            all points.
    """
    background, scene, box = evaluation_background(model), model.scene, model.scene.box.to(model.device)
    middle, half = box.mean(0), (box[1] - box[0]) / 2
    chunk = model.config.eval_num_rays_per_chunk
    for start in range(0, count, chunk):
        pixels = draw_pixels(dataset, min(chunk, count - start)).to(model.device)
        rays = dataset.cameras.pixel_rays(pixels, scene.near, scene.far, dataset.times)
        with torch.autocast(model.device.type, torch.bfloat16, enabled=model.uses_bfloat16):
            out = model.render(rays, background)
        depth = out.median_depth.float()
        positions = rays.origins + depth[:, None] * rays.directions
        selected = (out.accumulation >= OPAQUE) & (depth < rays.fars) & positions.isfinite().all(-1)
        if reach is not None:
            selected &= ((positions - middle).abs() <= reach * half).all(-1)
        normals = None if out.normals is None else safe_normalize(out.normals.float())[selected].cpu()
        yield SurfacePoints(positions[selected].cpu(), out.rgb.float().clamp(0, 1)[selected].cpu(), normals)


def joined(parts: Iterator[SurfacePoints]) -> SurfacePoints:
    """Concatenate `parts`, of which there must be at least one; without normals if any part has none."""
    chunks = list(parts)
    whole = SurfacePoints(torch.cat([p.positions for p in chunks]), torch.cat([p.colors for p in chunks]), None)
    if any(chunk.normals is None for chunk in chunks):
        return whole
    return replace(whole, normals=torch.cat([p.normals for p in chunks if p.normals is not None]))
