"""VolSDF: a signed distance on a hash grid; a Laplace distribution turns it into density.

Yariv et al., "Volume Rendering of Neural Implicit Surfaces", NeurIPS 2021. The hash grid and the network with ReLU
follow NeuS2 (Wang et al. 2023); levels open from coarse to fine as in Neuralangelo (Li et al. 2023). `--encoding
frequency` has the paper's networks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from nerfloom import ConfigError, Method, Sampler, Scene
from nerfloom.base.config import AUTO, Auto, Range
from nerfloom.fields.surface import VolSDFField
from nerfloom.methods._surfaces import (
    SurfaceConfig,
    SurfaceModel,
    decide_surface,
    make_sampler,
    renderer,
    surface_field,
)
from nerfloom.samplers.background import foreground
from nerfloom.samplers.error_bounded import EPSILON, ErrorBoundedSampler
from nerfloom.samplers.inside import inside_foreground


@dataclass(frozen=True)
class VolSDFConfig(SurfaceConfig, step_widths=0.0):
    """Settings of volsdf."""

    samplers: ClassVar[tuple[str, ...]] = ("occupancy", "error-bounded")
    RANGES: ClassVar[dict[str, Range]] = {"num_bound_steps": (4, 2**12), "opacity_error": (1e-4, 1)}
    sampler: Auto[Literal["occupancy", "error-bounded"]] = AUTO  # type: ignore[assignment]
    """occupancy: march through the occupied cells of the box. error-bounded: draw --num-nerf-samples samples per ray
    from an opacity with a bounded error, as in the paper. auto: occupancy."""
    num_bound_steps: int = 64
    """Number of distances evaluated along a ray at first, and in each further round until the bound holds
    (error-bounded)."""
    opacity_error: float = EPSILON
    """Maximum error of the opacity used to draw samples (error-bounded)."""


class VolSDF(SurfaceModel[VolSDFConfig]):
    """A model with the density of VolSDF, equation 2."""


def make_field(config: VolSDFConfig, scene: Scene) -> VolSDFField:
    """Return a field that starts as a ball."""
    return surface_field(VolSDFField, config, scene)


def sampler(config: VolSDFConfig, scene: Scene) -> Sampler:
    """Return the configured sampler, inside the sphere if there is a background.

    Raises:
        ConfigError: for pictures traced to the surface without an occupancy grid; rays are traced through its cells.
    """
    if config.sampler != "error-bounded":
        return make_sampler(config, scene)
    if config.eval_rendering == "surface":
        raise ConfigError("--eval-rendering surface traces occupied cells; take --sampler occupancy with it")
    bounded = ErrorBoundedSampler(
        foreground(config, scene).box, config.num_bound_steps, config.num_nerf_samples, config.opacity_error
    )
    return inside_foreground(config, scene, bounded)


METHOD = Method(
    VolSDFConfig(),
    paper="arXiv:2106.12052",
    field=make_field,
    sampler=sampler,
    renderer=renderer,
    model=VolSDF,
    decide=decide_surface,
)
