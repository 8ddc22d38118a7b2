"""What every sampler offers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Protocol, runtime_checkable

from torch import Tensor, nn

from framework.base.optimised import Optimised
from framework.fields.base import DensityFunction, Field
from framework.geometry.rays import Rays, Samples


class Sampler(nn.Module, ABC):
    """Chooses where along rays a field is evaluated. What it learns or remembers are parameters and buffers."""

    optimised: Optimised | None = None
    """How its parameters are optimised; as the model's if None."""
    samples_per_step: int | None = None
    """Samples that a training step should evaluate, the number of rays following; None for a fixed number of rays."""

    @abstractmethod
    def sample(self, rays: Rays, field: Field, jitter: bool) -> Samples:
        """Return samples for R rays.

        Args:
            rays: where to sample.
            field: what is sampled, for samplers that look before they choose. What they evaluate they attach to the
                result (`Samples.sigma`, `Samples.features`), gradients included.
            jitter: random positions (training) or fixed ones (evaluation).
        """

    def update(self, step: int, density: DensityFunction) -> None:
        """Refresh what the sampler knows; called before each training step. A function of `step` alone.

        Args:
            step: training steps done.
            density: the field's.
        """

    def losses(self, samples: Samples, weights: Tensor) -> dict[str, Tensor]:
        """Return named scalars by which the sampler itself learns.

        Args:
            samples: what it returned for a batch.
            weights: (N,) what the samples turned out to weigh.
        """
        return {}


@runtime_checkable
class StopsEarly(Protocol):
    """A sampler that ends rays where little light is left."""

    early_stop: float
    """Transmittance below which the rest of a ray is dropped: the most that a colour channel can be off by."""


@runtime_checkable
class SkipsCells(Protocol):
    """A sampler that passes over empty cells of a grid over a box."""

    box: Tensor
    """(2, 3) corners of the grid."""
    resolution: int
    """n, cells along each axis."""
    occupied: Tensor
    """(n^3,) bool, cells that are sampled; the cell's index is (x n + y) n + z."""
    carved: Tensor
    """(n^3,) bool, cells that are empty for good."""
    early_stop: float
    """As for `StopsEarly`."""

    def carve(self, hull: Tensor) -> None:
        """Empty all cells outside `hull` (n^3,) bool for good."""

    def forget(self) -> None:
        """Read `occupied` anew, which has changed."""
