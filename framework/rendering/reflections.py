"""Volume rendering of fields with reflections: pictures of the parts of colours."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from nerfloom.fields.base import Field
from nerfloom.fields.directional import HasLight
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.color import to_srgb
from nerfloom.kernels.compositing.density import ray_sum
from nerfloom.rendering.outputs import DIFFUSE, NORMALS, Output
from nerfloom.rendering.rendered import Rendered
from nerfloom.rendering.volume import VolumeRenderer, volume_render

SPECULAR = Output("specular", "color")
"""Reflected light, in display colours over black."""
ROUGHNESS = Output("roughness", "scalar")
"""Inverse concentration of reflected directions; 0 is a mirror."""


class ReflectionRenderer(VolumeRenderer):
    """Volume rendering with the parts of colours, normals and roughness; in training, `VolumeRenderer`."""

    outputs = (DIFFUSE, SPECULAR, NORMALS, ROUGHNESS)

    def shade(self, rays: Rays, samples: Samples, field: Field, background: Tensor) -> Rendered:
        if self.training:
            return super().shade(rays, samples, field, background)
        assert isinstance(field, HasLight)
        stopping = samples.sigma if samples.alpha is None else samples.alpha
        assert stopping is not None
        assert samples.features is not None
        owners = samples.ray_indices
        cameras = None if rays.camera_indices is None else rays.camera_indices.index_select(0, owners)
        light = field.light(samples.features, rays.directions.index_select(0, owners), cameras)
        is_alpha = samples.alpha is not None
        rendered = volume_render(rays, samples, stopping, light.rgb, background, is_alpha)
        assert rendered.weights is not None
        columns = {DIFFUSE: light.diffuse, SPECULAR: light.specular, NORMALS: light.normals}
        sums = {out.name: ray_sum(rendered.weights[:, None] * values, samples) for out, values in columns.items()}
        sums |= {out.name: to_srgb(sums[out.name]).clamp(max=1) for out in (DIFFUSE, SPECULAR)}
        sums[ROUGHNESS.name] = ray_sum(rendered.weights * light.roughness, samples)
        return replace(rendered, extras=sums)
