"""Traced rays: rendered or trained in one compiled call, if sampler, renderer and field are the basic ones."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.fields.base import Field, HasGridColor
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.traced.colors import GridColor, traced_colors
from nerfloom.kernels.traced.squared_error import PixelTargets, TracedError, traced_error
from nerfloom.kernels.traced.trace import GridDensity
from nerfloom.rendering.rendered import Rendered
from nerfloom.rendering.renderer import Renderer
from nerfloom.rendering.volume import VolumeRenderer, mean_distance
from nerfloom.samplers.base import Sampler
from nerfloom.samplers.occupancy import OccupancySampler


def error_of_traced(
    rays: Rays, pixels: PixelTargets, sampler: Sampler, field: Field, renderer: Renderer, thin: float = 0.0
) -> TracedError | None:
    """Return the mean squared error of pixels in training mode, computed by `traced_error`.

    Args:
        pixels: target pixels.
        thin: as in `traced_error`.

    Returns:
        None if there are no rays, or if a part overrides the basic computation.
    """
    if not sampler.training or not isinstance(sampler, OccupancySampler) or sampler.is_fixed(rays):
        return None
    parts = _plain(rays, sampler, field, renderer)
    if parts is None or (isinstance(renderer, VolumeRenderer) and renderer.unit_length is not None):
        return None
    return traced_error(sampler.begin(rays, True, sampler.train_early_stop), *parts, pixels, thin)


def traced_rays(rays: Rays, background: Tensor, sampler: Sampler, field: Field, renderer: Renderer) -> Rendered | None:
    """Render rays outside of training by `traced_colors`, without weights and samples.

    Args:
        background: (3,) colour in [0, 1].

    Returns:
        None if gradients are enabled, if there are no rays, or if a part overrides the basic computation.
    """
    if sampler.training or torch.is_grad_enabled() or not isinstance(sampler, OccupancySampler):
        return None
    parts = _plain(rays, sampler, field, renderer)
    if parts is None:
        return None
    behind = background.to(rays.origins).expand(len(rays), 3)
    shown = traced_colors(sampler.begin(rays, False, sampler.early_stop), *parts, behind)
    return Rendered(
        rgb=shown.color,
        depth=mean_distance(shown.moment, shown.opacity, rays.fars),
        median_depth=shown.median,
        accumulation=shown.opacity,
        num_samples=shown.num_samples,
        error_bound=sampler.early_stop,
    )


def _plain(
    rays: Rays, sampler: OccupancySampler, field: Field, renderer: Renderer
) -> tuple[GridDensity, GridColor] | None:
    """Return the field's density and colour for the kernels; None unless sampler, field and renderer are basic ones."""
    if type(sampler) is not OccupancySampler or sampler.endless or not len(rays):
        return None
    if type(renderer) is not VolumeRenderer or not isinstance(field, HasGridColor):
        return None
    density, color = field.grid_density(), field.grid_color()
    return None if density is None or color is None else (density, color)
