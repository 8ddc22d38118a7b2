"""Volume rendering: from samples with density and colour to a pixel."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from framework.fields.base import Field
from framework.geometry.rays import Rays, Samples
from framework.kernels.compositing import composite
from framework.kernels.math import scale_gradient
from framework.samplers.base import Sampler
from framework.samplers.inverse_cdf import inverse_cdf, uniform_variates
from framework.samplers.uniform import samples_from_points, stratified_points


@dataclass(frozen=True)
class Rendered:
    """What a model makes of R rays."""

    rgb: Tensor
    """(R, 3) colour over the background."""
    depth: Tensor
    """(R,) expected distance: the mean of t under the weights; the ray's far end where it met nothing."""
    median_depth: Tensor
    """(R,) distance at which half of the light is gone; the ray's far end where it never is."""
    accumulation: Tensor
    """(R,) opacity, the sum of the weights."""
    num_samples: int
    """Evaluations of the field on these rays; a proposal's are not counted."""
    weights: Tensor | None = None
    """(N,) weight of each sample, ray by ray, also after `per_pixel`."""
    samples: Samples | None = None
    """The samples themselves, likewise."""
    coarse: Rendered | None = None
    """An earlier level's picture, for methods that supervise it."""
    normals: Tensor | None = None
    """(R, 3) mean of the samples' normals under the weights, of a method that has them."""
    penalties: dict[str, Tensor] = field(default_factory=dict)
    """Named (R,) terms of the loss that only the samples' own values tell, also after `per_pixel`."""

    def over(self, coarse: Rendered) -> Rendered:
        """This picture with the coarse level it was refined from; the evaluations of both count."""
        return replace(self, coarse=coarse, num_samples=self.num_samples + coarse.num_samples)

    def per_pixel(self, rays_per_pixel: int) -> Rendered:
        """The picture of R / rays_per_pixel pixels, each of as many successive rays; `weights`, `samples` stay theirs.

        Colour and opacity are means, and so is the depth, over the rays as far as they are opaque; the median depth is
        one ray's.
        """
        if rays_per_pixel == 1:
            return self
        shape = (-1, rays_per_pixel)
        share, depth = self.accumulation.detach().view(shape), self.depth.view(shape)
        seen = share.sum(1) > 1e-6
        share = torch.where(seen[:, None], share, torch.ones_like(share))
        return replace(
            self,
            rgb=self.rgb.view(*shape, 3).mean(1),
            depth=(depth * share).sum(1) / share.sum(1),
            median_depth=self.median_depth.view(shape).median(1).values,
            accumulation=self.accumulation.view(shape).mean(1),
            normals=None if self.normals is None else self.normals.view(*shape, 3).mean(1),
            coarse=None if self.coarse is None else self.coarse.per_pixel(rays_per_pixel),
        )


def volume_render(rays: Rays, samples: Samples, sigma: Tensor, rgb: Tensor, background: Tensor) -> Rendered:
    """Composite packed samples (NeRF, equation 3).

    Args:
        rays: R rays, for their far end.
        samples: N intervals.
        sigma: (N,) density.
        rgb: (N, 3) colour.
        background: (R, 3) or (3,) what shows where the ray is not opaque.
    """
    sigma, rgb = _at_least_float32(sigma), _at_least_float32(rgb)
    found = composite(samples, sigma, rgb, background.to(rgb.dtype), rays.fars)
    seen = found.opacity.detach() > 1e-6
    mean = found.moment / torch.where(seen, found.opacity.detach(), torch.ones_like(found.moment))
    depth = torch.where(seen, torch.minimum(mean, rays.fars), rays.fars)
    return Rendered(found.color, depth, found.median, found.opacity, len(samples), found.weights, samples)


def _at_least_float32(values: Tensor) -> Tensor:
    return values if values.dtype == torch.float64 else values.float()


def render_field(field: Field, sampler: Sampler, rays: Rays, background: Tensor, jitter: bool) -> Rendered:
    """Sample, evaluate and composite: what most methods do with a ray.

    A sampler that has evaluated density already hands it over; it is not evaluated again.
    """
    samples = sampler.sample(rays, field, jitter)
    if samples.sigma is None or samples.features is None:
        samples = samples.evaluated(*field.density(samples.positions(rays), samples.times(rays)))
    return shade(field, rays, samples, background)


def shade(
    field: Field, rays: Rays, samples: Samples, background: Tensor, gradient_factors: Tensor | None = None
) -> Rendered:
    """Colour and composite samples whose density and features are attached.

    `gradient_factors` (N,) multiply the gradients of density and colour; None for 1.
    """
    if samples.sigma is None or samples.features is None:
        raise ValueError("shade() needs samples whose density and features are attached")
    owners = samples.ray_indices
    cameras = None if rays.camera_indices is None else rays.camera_indices[owners]
    sigma, rgb = samples.sigma, field.color(samples.features, rays.directions.index_select(0, owners), cameras)
    if gradient_factors is not None:
        sigma, rgb = scale_gradient(sigma, gradient_factors), scale_gradient(rgb, gradient_factors)
    return volume_render(rays, samples, sigma, rgb, background)


def render_hierarchical(
    coarse: Field, fine: Field, rays: Rays, background: Tensor, counts: tuple[int, int], jitter: bool
) -> Rendered:
    """Stratified samples for one field; for another these, and more where the first found light (NeRF, section 5.2).

    Args:
        counts: of the stratified samples, and of those drawn.
    """
    points = stratified_points(rays, counts[0], jitter)
    first = _render_points(coarse, rays, points, background)
    assert first.weights is not None
    weights = first.weights.view(points.shape).detach()
    middles = (points[:, 1:] + points[:, :-1]) / 2
    drawn = inverse_cdf(middles, weights[:, 1:-1], uniform_variates(len(rays), counts[1], jitter, points.device))
    merged = torch.cat([points, drawn], dim=-1).sort(dim=-1).values
    return _render_points(fine, rays, merged, background).over(first)


def _render_points(field: Field, rays: Rays, points: Tensor, background: Tensor) -> Rendered:
    samples = samples_from_points(points)
    samples = samples.evaluated(*field.density(samples.positions(rays), samples.times(rays)))
    return shade(field, rays, samples, background)
