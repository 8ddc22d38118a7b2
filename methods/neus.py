"""NeuS: a signed distance on a hash grid; the surface is where the distance is 0.

Wang et al., "NeuS: Learning Neural Implicit Surfaces by Volume Rendering for Multi-view Reconstruction", NeurIPS 2021.
The hash grid and the network with ReLU follow NeuS2 (Wang et al. 2023); levels open from coarse to fine as in
Neuralangelo (Li et al. 2023). `--encoding frequency` has the paper's networks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from nerfloom import Method, Scene
from nerfloom.base.config import Range
from nerfloom.fields.surface import AnnealedSharpness, NeuSField
from nerfloom.methods._surfaces import (
    SurfaceConfig,
    SurfaceModel,
    decide_surface,
    make_sampler,
    renderer,
    surface_field,
)


@dataclass(frozen=True)
class NeuSConfig(SurfaceConfig):
    """Settings of neus."""

    RANGES: ClassVar[dict[str, Range]] = {"anneal_slope_until": (0, 1)}
    anneal_slope_until: float = 0.5
    """Fraction of the budget until the annealing of the slope ends (`surface_opacity`)."""


class NeuS(SurfaceModel[NeuSConfig]):
    """A model with the opacity of NeuS, equation 13."""

    field: NeuSField

    def before_step(self, step: int, progress: float) -> None:
        super().before_step(step, progress)
        until = self.config.anneal_slope_until
        self.field.sharpness.anneal(round(min(progress / until, 1.0) * 1024) / 1024 if until else 1.0)


def make_field(config: NeuSConfig, scene: Scene) -> NeuSField:
    """Return a field that starts as a ball."""
    return surface_field(NeuSField, config, scene, AnnealedSharpness)


METHOD = Method(
    NeuSConfig(),
    paper="arXiv:2106.10689",
    field=make_field,
    sampler=make_sampler,
    renderer=renderer,
    model=NeuS,
    decide=decide_surface,
)
