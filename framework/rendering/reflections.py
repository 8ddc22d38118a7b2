"""Volume rendering of fields with reflections: what they are made of, as pictures and as penalties."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from nerfloom.fields.base import Field
from nerfloom.fields.normals import normal_penalties
from nerfloom.fields.reflective import ReflectiveField
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.color import to_srgb
from nerfloom.kernels.compositing.density import ray_sum
from nerfloom.rendering.outputs import NORMALS, Output
from nerfloom.rendering.rendered import Rendered
from nerfloom.rendering.volume import VolumeRenderer

DIFFUSE, SPECULAR = Output("diffuse", "color"), Output("specular", "color")
"""Light that leaves surfaces in all directions alike, and reflected light, each in display colours over black."""
ROUGHNESS = Output("roughness", "scalar")
"""Inverse concentration of reflected directions; 0 is a mirror."""


class ReflectionRenderer(VolumeRenderer):
    """Volume rendering with the parts of colours and predicted normals or, in training, the normals' penalties.

    Args:
        unit_length: gradients are scaled within this distance from the camera, scene units; None for no scaling.
        thin: samples are thinned below this fraction of the mean gradient; 0 for none.
    """

    outputs = (DIFFUSE, SPECULAR, NORMALS, ROUGHNESS)

    def shade(self, rays: Rays, samples: Samples, field: Field, background: Tensor) -> Rendered:
        rendered = super().shade(rays, samples, field, background)
        assert isinstance(field, ReflectiveField)
        assert samples.features is not None
        assert rendered.weights is not None
        weights, directions = rendered.weights, rays.directions.detach().index_select(0, samples.ray_indices)
        if self.training:
            predicted, normals = field.predicted_normals(samples.features), field.density_normals(samples.features)
            penalties = normal_penalties(predicted, normals, directions, weights, samples)
            return replace(rendered, extras={**rendered.extras, **penalties})
        light = field.light(samples.features, directions)
        columns = {DIFFUSE: light.diffuse, SPECULAR: light.specular, NORMALS: light.normals}
        sums = {output.name: ray_sum(weights[:, None] * values, samples) for output, values in columns.items()}
        sums |= {output.name: to_srgb(sums[output.name]).clamp(max=1) for output in (DIFFUSE, SPECULAR)}
        sums[ROUGHNESS.name] = ray_sum(weights * light.roughness, samples)
        return replace(rendered, extras={**rendered.extras, **sums})
