"""Volume rendering of fields with reflections: pictures of the parts of colours, and penalties of normals."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from nerfloom.fields.base import Field
from nerfloom.fields.normals import normal_penalties
from nerfloom.fields.reflective import ReflectiveField
from nerfloom.geometry.points import interval_points
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.color import to_srgb
from nerfloom.kernels.compositing.density import ray_sum
from nerfloom.kernels.march.waves import Wave
from nerfloom.rendering.outputs import NORMALS, Output
from nerfloom.rendering.rendered import Rendered
from nerfloom.rendering.volume import VolumeRenderer, volume_render

DIFFUSE, SPECULAR = Output("diffuse", "color"), Output("specular", "color")
"""Light that leaves surfaces equally in all directions, and reflected light, each in display colours over black."""
ROUGHNESS = Output("roughness", "scalar")
"""Inverse concentration of reflected directions; 0 is a mirror."""
EVERY = 4
"""In training, the density's normals are computed at one in this many samples."""


class ReflectionRenderer(VolumeRenderer):
    """Volume rendering with the parts of colours and predicted normals or, in training, the normals' penalties."""

    outputs = (DIFFUSE, SPECULAR, NORMALS, ROUGHNESS)

    def shade(self, rays: Rays, samples: Samples, field: Field, background: Tensor) -> Rendered:
        assert isinstance(field, ReflectiveField)
        assert samples.features is not None
        assert samples.sigma is not None
        directions = rays.directions.detach().index_select(0, samples.ray_indices)
        if self.training:
            rendered = super().shade(rays, samples, field, background)
            assert rendered.weights is not None
            predicted = field.predicted_normals(samples.features)
            normals = _of_some(rays, samples, field)
            penalties = normal_penalties(predicted, normals, directions, rendered.weights, samples)
            penalties["normals_penalty"] = EVERY * penalties["normals_penalty"]  # on average, that of all samples
            return replace(rendered, extras={**rendered.extras, **penalties})
        light = field.light(samples.features, directions)  # once, for colours and their parts
        rendered = volume_render(rays, samples, samples.sigma, light.rgb, background)
        assert rendered.weights is not None
        columns = {DIFFUSE: light.diffuse, SPECULAR: light.specular, NORMALS: light.normals}
        sums = {out.name: ray_sum(rendered.weights[:, None] * values, samples) for out, values in columns.items()}
        sums |= {out.name: to_srgb(sums[out.name]).clamp(max=1) for out in (DIFFUSE, SPECULAR)}
        sums[ROUGHNESS.name] = ray_sum(rendered.weights * light.roughness, samples)
        return replace(rendered, extras=sums)


def _of_some(rays: Rays, samples: Samples, field: ReflectiveField) -> Tensor:
    """Return unit normals (N, 3) of the density at one in `EVERY` samples, and 0 at the others."""
    places = torch.arange(len(samples), device=samples.t_starts.device)[int(torch.randint(EVERY, ())) :: EVERY]
    owners, starts, ends = (each[places] for each in (samples.ray_indices, samples.t_starts, samples.t_ends))
    some = Wave(starts, ends, owners, rays.points(owners, (starts + ends) / 2).detach())
    found = field.density_normals(interval_points(rays, owners, some, some.positions, field.footprint))
    return found.new_zeros(len(samples), 3).index_copy(0, places, found)
