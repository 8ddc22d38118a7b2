"""The interface of samplers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Protocol, runtime_checkable

from torch import Tensor, nn

from nerfloom.base.optimised import Optimised
from nerfloom.base.protocols import SeesRegistered
from nerfloom.base.step_kind import StepKind
from nerfloom.fields.base import DensityFunction, Field
from nerfloom.geometry.rays import Rays, Samples


class Sampler(nn.Module, ABC):
    """Base class of samplers, which choose the positions along rays where a field is evaluated.

    Learnt values of a sampler are parameters; its other state is in buffers.
    """

    optimised: Optimised | None = None
    """Optimiser settings of its parameters; if None, the model's."""
    samples_per_step: int | None = None
    """Target number of samples per training step; the number of rays adapts. None for a fixed number of rays."""
    has_coarse_level: bool = False
    """Whether its samples include a coarse level, which is rendered and supervised too (`Samples.coarse`)."""
    carries_gradients: bool = True
    """Whether rays may require a gradient, which their samples carry, so that poses can be refined."""
    learns_from_weights: bool = False
    """Whether the sampler learns by its own `loss`; the method's objective then includes `SamplerLoss`."""

    @abstractmethod
    def sample(self, rays: Rays, field: Field, jitter: bool) -> Samples:
        """Return samples for R rays.

        Args:
            rays: the rays to sample.
            field: the field, for samplers that evaluate it in order to sample. Such samplers attach the values to the
                result (`Samples.sigma`, `Samples.features`), gradients included.
            jitter: True for random positions (training), False for fixed ones (evaluation).
        """

    def update(self, step: int, density: DensityFunction) -> None:
        """Update the state of the sampler; called before each training step. Schedules depend on `step` only.

        Args:
            step: number of training steps done.
            density: density of the field.
        """

    def step_kind(self, step: int) -> StepKind:
        """Return the kind of training step `step`: steps of one kind differ only in the values of tensors."""
        return StepKind(varies="the number of samples on a ray varies")

    def read_counts(self) -> None:
        """Read counts from the device and adapt sizes; called when the device is waited for anyway."""

    def loss(self, samples: Samples, weights: Tensor) -> Tensor | None:
        """Return the loss () that trains the sampler by `weights` (N,) of its N `samples`; None in other steps."""
        return None


@runtime_checkable
class StopsEarly(Protocol, metaclass=SeesRegistered):
    """A sampler that ends a ray where its transmittance is low."""

    early_stop: float
    """Transmittance below which the rest of a ray is dropped: the maximum error of a colour channel in [0, 1]."""


@runtime_checkable
class Carved(Protocol, metaclass=SeesRegistered):
    """A part with a grid over a box, or over L nested boxes, where cells that images show to be empty are marked."""

    box: Tensor
    """(2, 3) corners of the grid, scene units; of the smallest box if there are several."""
    resolution: int
    """Number n of cells along each axis of a box."""
    levels: int
    """Number L of boxes."""
    slices: int
    """Number T of equal parts of the time from 0 to 1, each with its own cells; 1 for a static scene, or if there are
    several boxes."""
    carved: Tensor
    """(L n^3,) or (T n^3,) bool, True for cells that stay empty; cell (x, y, z) of box or slice l has the index
    ((l n + x) n + y) n + z. This includes cells in the middle of a box that a smaller box covers."""

    def carve(self, hull: Tensor) -> None:
        """Mark all cells outside `hull`, (L n^3,) or (T n^3,) bool, as empty, permanently."""


@runtime_checkable
class SkipsCells(Carved, StopsEarly, Protocol, metaclass=SeesRegistered):
    """A sampler that skips the empty cells of a grid (`Occupancy`)."""

    occupied: Tensor
    """(L n^3,) or (T n^3,) bool, True for cells that are sampled, in the order of `carved`."""

    def occupied_when(self, time: float | None = None) -> Tensor:
        """Return the cells (L n^3,) that are occupied in the time slice of `time`; at any time if it is None."""

    def forget(self) -> None:
        """Discard cached values of `occupied`; must be called after `occupied` has changed."""
