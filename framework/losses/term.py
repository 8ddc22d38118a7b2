"""The interface of a loss term. A method lists its terms; the list is its objective."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

from torch import Tensor

from nerfloom.data.pixels.batch import PixelBatch
from nerfloom.rendering.rendered import Pixels, Rendered

if TYPE_CHECKING:
    from nerfloom.ray_model import RayModel


@dataclass(frozen=True)
class RenderedBatch:
    """A batch and its rendering."""

    batch: PixelBatch
    """P pixels with their known values."""
    rendered: Rendered
    """The rays of the pixels, `batch.rays_per_pixel` for each."""
    model: RayModel[Any]
    """The model in training."""
    step: int
    """Number of training steps done."""

    @cached_property
    def pixels(self) -> Pixels:
        """The P pixels as rendered."""
        return self.rendered.to_pixels(self.batch.rays_per_pixel, self.model.outputs)


class LossTerm(ABC):
    """One term of the objective of a method that casts rays.

    Args:
        name: name of the term in logs.
        weight: factor of the term, or the name of the setting that holds it.
    """

    def __init__(self, name: str, weight: float | str = 1.0) -> None:
        self.name, self.weight = name, weight

    def factor(self, config: Any, step: int) -> float:
        """Return the factor of the term; a term with a factor of 0 is not computed.

        Args:
            config: the method's settings, decided.
            step: number of training steps done.
        """
        return float(getattr(config, self.weight)) if isinstance(self.weight, str) else self.weight

    def applies(self, batch: PixelBatch, model: RayModel[Any]) -> bool:
        """Return whether the term applies to a batch, before the batch is rendered; True by default.

        Args:
            batch: pixels with their known values.
            model: the model in training.
        """
        return True

    @abstractmethod
    def __call__(self, shown: RenderedBatch) -> Tensor | dict[str, Tensor] | None:
        """Return the value () of the term before its factor, or several by name; None if it does not apply.

        Args:
            shown: the batch, its rendering and the model.
        """

    def varies(self, config: Any) -> str | None:
        """Return why a training step with this term cannot be captured and repeated; None if it can.

        Args:
            config: the method's settings, decided.
        """
        return None
