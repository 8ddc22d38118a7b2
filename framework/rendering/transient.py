"""Volume rendering of a static and a transient field: NeRF in the Wild (Martin-Brualla et al. 2021), section 4.2."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from nerfloom.fields.base import Field
from nerfloom.fields.transient import TransientHead
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.compositing.density import ray_sum
from nerfloom.rendering.outputs import Output
from nerfloom.rendering.rendered import Rendered
from nerfloom.rendering.volume import VolumeRenderer, volume_render

STATIC = Output("static", "color", of_training=True)
TRANSIENT = Output("transient", "color", of_training=True)
UNCERTAINTY = Output("uncertainty", "scalar", of_training=True)


class TransientRenderer(VolumeRenderer):
    """Volume rendering of the static field alone, and together with the transient part of the rays' images.

    In an interval where both have density, each emits light in proportion to it. This is the integral of equation 3 for
    constant densities. The paper's equation 8 adds their opacities instead, which is the same for thin intervals.

    Depth, opacity and weights describe the static part; `extras["opacity"]` is of both parts. The uncertainty is
    composited by the transient density alone (equation 11), so that it does not change the static part.

    Args:
        head: the transient part.
        least: uncertainty where nothing is transient.
        unit_length: gradients are scaled within this distance from the camera, scene units; None for no scaling.
        thin: samples are thinned below this fraction of the mean gradient of the static part; 0 for none.
    """

    outputs = (STATIC, TRANSIENT, UNCERTAINTY)

    def __init__(self, head: TransientHead, least: float, unit_length: float | None, thin: float = 0.0) -> None:
        super().__init__(unit_length, thin)
        self.head, self.least = head, least

    def shade(self, rays: Rays, samples: Samples, field: Field, background: Tensor) -> Rendered:
        sigma, rgb = self.values(rays, samples, field)
        static = volume_render(rays, samples, sigma, rgb, background)
        extras = {STATIC.name: static.rgb, TRANSIENT.name: torch.zeros_like(static.rgb)}
        extras[UNCERTAINTY.name] = torch.full_like(static.depth, self.least)
        extras["opacity"] = static.accumulation
        vectors = self.head.vectors_of(rays)
        if vectors is None:
            return replace(static, extras=extras)
        assert samples.features is not None
        density, color, doubt = self.head(
            samples.features, samples.positions(rays).detach(), vectors.index_select(0, samples.ray_indices)
        )
        share = (density / (sigma + density).clamp(min=torch.finfo(torch.float32).tiny))[:, None]
        both = volume_render(rays, samples, sigma + density, torch.lerp(rgb, color, share), background)
        assert both.weights is not None
        extras["opacity"] = both.accumulation
        extras[TRANSIENT.name] = ray_sum((both.weights[:, None] * share * color).detach(), samples)
        nothing_behind, doubts = torch.zeros_like(background), doubt[:, None].expand(-1, 3)
        extras[UNCERTAINTY.name] = self.least + volume_render(rays, samples, density, doubts, nothing_behind).rgb[:, 0]
        extras["transient_density"] = ray_sum(density, samples) / samples.counts.clamp(min=1)
        return replace(static, rgb=both.rgb, extras=extras)
