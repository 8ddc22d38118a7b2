"""The interface of renderers, which turn samples into colours and depths of rays."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor, nn

from nerfloom.base.optimised import Optimised
from nerfloom.fields.base import Field
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.rendering.outputs import Output
from nerfloom.rendering.rendered import Rendered


class Renderer(nn.Module, ABC):
    """Base class of renderers.

    A renderer with learnt components (normals, a sky) holds their parameters; `self.training` is True in training.
    """

    optimised: Optimised | None = None
    """Optimiser settings of its parameters; if None, the model's."""
    outputs: tuple[Output, ...] = ()
    """Declarations of outputs in addition to colour, depths and opacity (`Rendered.extras`)."""

    @abstractmethod
    def render(self, rays: Rays, samples: Samples, field: Field, background: Tensor) -> Rendered:
        """Render R rays from their samples.

        Args:
            rays: the rays; R may be 0.
            samples: samples along the rays. If the sampler has attached density and features (`Samples.sigma`,
                `Samples.features`), these are used and the field is not evaluated again.
            field: the field that was sampled.
            background: (R, 3) or (3,) colour in [0, 1] of the background.
        """
