"""The error of traced rays, learnt in one compiled call where sampler, renderer and field are the plain ones."""

from __future__ import annotations

from torch import Tensor

from framework.fields.base import Field, HasGridColor
from framework.geometry.rays import Rays
from framework.kernels.traced_error import TracedError, knows, traced_error
from framework.rendering.renderer import Renderer
from framework.rendering.volume import VolumeRenderer
from framework.samplers.base import Sampler
from framework.samplers.occupancy import OccupancySampler


def error_of_traced(
    rays: Rays,
    sampler: Sampler,
    field: Field,
    renderer: Renderer,
    background: Tensor,
    target: Tensor,
    weights: Tensor | None,
) -> TracedError | None:
    """Return the mean squared error of pixels as `traced_error` computes it, in training mode.

    Args:
        rays: R rays.
        sampler: chooses the positions along each ray.
        field: density and colour.
        renderer: turns samples into colours.
        background: (R, 3) colour behind each ray.
        target: (P, 3) true colours, of pixels of R / P consecutive rays.
        weights: (P,) factors of the pixels; None for 1.

    Returns:
        None where one of the parts is another than `traced_error` knows, before anything is drawn at random.
    """
    if type(sampler) is not OccupancySampler or sampler.endless or not sampler.training:
        return None
    if type(renderer) is not VolumeRenderer or not isinstance(field, HasGridColor):
        return None
    density, color = field.grid_density(), field.grid_color()
    if density is None or color is None or not knows(rays.origins, density, color, background, target, weights):
        return None
    marched = sampler.begin(rays, True, sampler.train_early_stop)
    return traced_error(marched, density, color, background, target, weights)
