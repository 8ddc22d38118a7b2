"""Samples with gradients to rays, from a sampler without such gradients."""

from __future__ import annotations

from dataclasses import replace

import torch

from nerfloom.fields.base import Field
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.argument_checks import is_followed
from nerfloom.samplers.base import Sampler
from nerfloom.samplers.wrapping import WrappingSampler


class EvaluatedAgain(WrappingSampler):
    """Samples of another `sampler`; if rays require a gradient, the renderer evaluates the field at them once more.

    The distances of samples along their rays have no gradient, as with all samplers. Their positions, densities or
    opacities, and colours have the gradient of the rays.
    """

    def __init__(self, sampler: Sampler) -> None:
        super().__init__(sampler)
        self.carries_gradients = True

    def sample(self, rays: Rays, field: Field, jitter: bool) -> Samples:
        if not is_followed(rays.origins, rays.directions):
            return self.sampler.sample(rays, field, jitter)
        with torch.no_grad():
            chosen = self.sampler.sample(rays.detached(), field, jitter)
        return replace(chosen, sigma=None, alpha=None, features=None)
