"""What every sampler offers."""

from __future__ import annotations

from typing import Protocol

from framework.fields.base import DensityFunction, Field
from framework.geometry.rays import Rays, Samples


class Sampler(Protocol):
    """Chooses samples. A sampler that learns is a `torch.nn.Module` as well, so that checkpoints hold its state."""

    def sample(self, rays: Rays, field: Field, jitter: bool) -> Samples:
        """Samples for R rays.

        Args:
            rays: where to sample.
            field: what is sampled, for samplers that look before they choose. What they evaluate they attach to the
                result (`Samples.sigma`, `Samples.features`), gradients included.
            jitter: random positions (training) or fixed ones (evaluation).
        """

    def update(self, step: int, density: DensityFunction) -> None:
        """Refresh what the sampler knows; called before each training step. A function of `step` alone."""
