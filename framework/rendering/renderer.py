"""What every renderer offers: from what was sampled to what is seen."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor, nn

from framework.base.optimised import Optimised
from framework.fields.base import Field
from framework.geometry.rays import Rays, Samples
from framework.rendering.rendered import Rendered


class Renderer(nn.Module, ABC):
    """From samples along rays to what the rays show.

    A renderer that learns (normals, a sky) holds its parameters; `self.training` tells training from evaluation.
    """

    optimised: Optimised | None = None
    """How its parameters are optimised; as the model's if None."""

    @abstractmethod
    def render(self, rays: Rays, samples: Samples, field: Field, background: Tensor) -> Rendered:
        """Return what R rays show.

        Args:
            rays: the rays; R may be 0.
            samples: samples along them, with density and features where the sampler has evaluated these already
                (`Samples.sigma`, `.features`): they are not evaluated again.
            field: what was sampled.
            background: (R, 3) or (3,) colour that shows as far as a ray is not opaque.
        """
