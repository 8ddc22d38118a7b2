"""The error of traced rays, learnt in one compiled call where sampler, renderer and field are the plain ones."""

from __future__ import annotations

from framework.fields.base import Field, HasGridColor
from framework.geometry.rays import Rays
from framework.kernels.traced_error import PixelTargets, TracedError, traced_error
from framework.rendering.renderer import Renderer
from framework.rendering.volume import VolumeRenderer
from framework.samplers.base import Sampler
from framework.samplers.occupancy import OccupancySampler


def error_of_traced(
    rays: Rays, pixels: PixelTargets, sampler: Sampler, field: Field, renderer: Renderer, thin: float = 0.0
) -> TracedError | None:
    """Return the mean squared error of pixels in training mode, by `traced_error`.

    Args:
        rays: R rays.
        pixels: what these should show.
        sampler: chooses the positions along each ray.
        field: density and colour.
        renderer: turns samples into colours.
        thin: as in `traced_error`.

    Returns:
        None without rays, or where one of the parts computes something else.
    """
    if type(sampler) is not OccupancySampler or sampler.endless or not (sampler.training and len(rays)):
        return None
    if sampler.is_fixed(rays):
        return None
    changed = vars(sampler).keys() & {"sample"} | vars(renderer).keys() & {"render", "shade"}
    if type(renderer) is not VolumeRenderer or renderer.unit_length is not None or changed:
        return None
    if not isinstance(field, HasGridColor):
        return None
    density, color = field.grid_density(), field.grid_color()
    if density is None or color is None:
        return None
    return traced_error(sampler.begin(rays, True, sampler.train_early_stop), density, color, pixels, thin)
