"""Doubtful: instant-ngp with an uncertainty of each ray, which weighs its error (as NeRF in the Wild, equation 13)."""

from __future__ import annotations

from dataclasses import dataclass, replace

from torch import Tensor, nn
from torch.nn.functional import softplus

from nerfloom import Field, RayModel, Rays, Rendered, Samples, Scene
from nerfloom.fields.encoded import NUM_FEATURES
from nerfloom.kernels.compositing.density import ray_sum
from nerfloom.losses.term import RenderedBatch
from nerfloom.losses.terms import ColorError, SamplerLoss
from nerfloom.methods import instant_ngp
from nerfloom.rendering.outputs import Output
from nerfloom.rendering.volume import VolumeRenderer

UNCERTAINTY = Output("uncertainty", "scalar", "uncertainty")


@dataclass(frozen=True)
class DoubtfulConfig(instant_ngp.InstantNGPConfig):
    """Settings of doubtful."""

    least_uncertainty: float = 0.1
    """Minimum uncertainty of a ray."""


class DoubtfulRenderer(VolumeRenderer):
    """Volume rendering of colours and of an uncertainty.

    Args:
        least: uncertainty of a ray that meets nothing doubtful.
    """

    outputs = (UNCERTAINTY,)

    def __init__(self, least: float) -> None:
        super().__init__()
        self.least, self.head = least, nn.Linear(NUM_FEATURES, 1)

    def shade(self, rays: Rays, samples: Samples, field: Field, background: Tensor) -> Rendered:
        rendered = super().shade(rays, samples, field, background)
        assert samples.features is not None
        assert rendered.weights is not None
        doubt = softplus(self.head(samples.features.float()))[:, 0]
        found = self.least + ray_sum(rendered.weights.detach() * doubt, samples)
        return replace(rendered, extras={**rendered.extras, UNCERTAINTY.name: found})


class DoubtedError(ColorError):
    """Error of colours in units of their uncertainty, which is not to be large."""

    def error(self, rgb: Tensor, shown: RenderedBatch) -> Tensor:
        doubt = shown.pixels.extras[UNCERTAINTY.name]
        squares = (rgb - shown.batch.rgb).square().mean(-1)
        return (squares / (2 * doubt.square()) + doubt.log()).mean()


class Doubtful(RayModel[DoubtfulConfig]):
    """A model that learns how far it can trust the images."""

    losses = (DoubtedError(), SamplerLoss())


def renderer(config: DoubtfulConfig, scene: Scene) -> DoubtfulRenderer:
    """Return the renderer of colours and uncertainty."""
    return DoubtfulRenderer(config.least_uncertainty)


METHOD = replace(instant_ngp.METHOD, config=DoubtfulConfig(), renderer=renderer, model=Doubtful, paper="none")
