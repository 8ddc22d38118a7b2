"""VolSDF: a signed distance on a hash grid, whose density is a Laplace distribution's.

Yariv et al., "Volume Rendering of Neural Implicit Surfaces", NeurIPS 2021. The hash grid and the network with ReLU are
those of NeuS2 (Wang et al. 2023); levels open from coarse to fine as in Neuralangelo (Li et al. 2023).
"""

from __future__ import annotations

from dataclasses import dataclass

from nerfloom import Method, Scene
from nerfloom.fields.surface import VolSDFField
from nerfloom.methods._surfaces import (
    SurfaceConfig,
    SurfaceModel,
    decide_surface,
    field_parts,
    make_sampler,
    renderer,
)


@dataclass(frozen=True)
class VolSDFConfig(SurfaceConfig, step_widths=0.0):
    """Settings of volsdf."""


class VolSDF(SurfaceModel[VolSDFConfig], plain=True):
    """A model with the density of VolSDF, equation 2."""


def make_field(config: VolSDFConfig, scene: Scene) -> VolSDFField:
    """Return a field that starts as a ball."""
    return VolSDFField(**field_parts(config, scene))


METHOD = Method(
    VolSDFConfig(),
    paper="arXiv:2106.12052",
    field=make_field,
    sampler=make_sampler,
    renderer=renderer,
    model=VolSDF,
    decide=decide_surface,
)
"""The method."""
