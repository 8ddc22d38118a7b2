"""Volume rendering: NeRF (Mildenhall et al. 2020), equation 3; gradients scaled down near cameras.

Gradient scaling follows Philip and Deschaintre 2023, "Gradient Scaling for Floater-Free Neural Radiance Fields".
Content near a camera is seen by few other cameras and sampled more densely, so without scaling it learns faster than
the rest.
"""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.base.config import RayConfig
from nerfloom.data.scene import Scene
from nerfloom.fields.base import Field, HasAlpha
from nerfloom.geometry.bounds import half_edge
from nerfloom.geometry.points import sample_points
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.compositing.alpha import composite_alpha
from nerfloom.kernels.compositing.density import Composited, composite
from nerfloom.kernels.compositing.thinning import thinned
from nerfloom.kernels.math import at_least_float32, scale_gradient
from nerfloom.rendering.rendered import Rendered
from nerfloom.rendering.renderer import Renderer


class VolumeRenderer(Renderer):
    """A renderer that composites densities, or alphas if the field has them (`HasAlpha`): NeRF, equation 3.

    Subclasses can override `shade`, which computes colours and weights of samples, or `render`, which calls `shade`.

    Args:
        unit_length: within this distance from the camera, scene units, gradients are scaled down in training by
            squared distance; None for no scaling.
        thin: samples below this fraction of the mean gradient are thinned in training on the CPU; 0 for none.
    """

    def __init__(self, unit_length: float | None = None, thin: float = 0.0) -> None:
        super().__init__()
        self.unit_length, self.thin = unit_length, thin

    def render(self, rays: Rays, samples: Samples, field: Field, background: Tensor) -> Rendered:
        rendered = self.shade(rays, evaluated(rays, samples, field), field, background)
        if samples.coarse is None:
            return rendered
        coarse = samples.coarse
        return rendered.over(self.shade(rays, coarse.samples, coarse.field, background))

    def shade(self, rays: Rays, samples: Samples, field: Field, background: Tensor) -> Rendered:
        """Compute the colours of samples and composite them.

        Args:
            rays: R rays.
            samples: N samples along the rays, with density or alpha, and features, attached.
            field: the field that was sampled.
            background: (R, 3) or (3,) colour in [0, 1] of the background.

        Raises:
            ValueError: if the samples have no density or no features.
        """
        return volume_render(
            rays, samples, *self.values(rays, samples, field), background, is_alpha=samples.alpha is not None
        )

    def values(self, rays: Rays, samples: Samples, field: Field) -> tuple[Tensor, Tensor]:
        """Return the density or alpha (N,) of samples, and their colours (N, 3); in training with changed gradients.

        `rays`, `samples`, `field` and the error raised are as in `shade`.
        """
        stopping = samples.sigma if samples.alpha is None else samples.alpha
        if stopping is None or samples.features is None:
            raise ValueError("rendering needs samples with density and features")
        owners = samples.ray_indices
        cameras = None if rays.camera_indices is None else rays.camera_indices.index_select(0, owners)
        rgb = field.color(samples.features, rays.directions.index_select(0, owners), cameras)
        if self.training and self.thin and rays.origins.device.type == "cpu":
            stopping, rgb = thinned(stopping, rgb, self.thin)
        if self.training and self.unit_length is not None:
            factors = (samples.t / self.unit_length).square().clamp(max=1)
            stopping, rgb = scale_gradient(stopping, factors), scale_gradient(rgb, factors)
        return stopping, rgb


def scaled_up_to(config: RayConfig, scene: Scene) -> float | None:
    """Return the distance from cameras where the scaling of gradients ends, scene units; None for no scaling."""
    return half_edge(scene.box) if config.gradient_scaling else None


def evaluated(rays: Rays, samples: Samples, field: Field) -> Samples:
    """Return `samples` of `rays` with density or alpha, and features, of `field`; evaluated samples are unchanged."""
    if samples.features is not None and (samples.sigma is not None or samples.alpha is not None):
        return samples
    points = sample_points(rays, samples, field.footprint)
    if isinstance(field, HasAlpha):
        directions = rays.directions.index_select(0, samples.ray_indices)
        alpha, features = field.alpha(points, directions, samples.deltas)
        return samples.with_alpha(alpha, features)
    return samples.evaluated(*field.density(points))


def volume_render(
    rays: Rays, samples: Samples, sigma: Tensor, rgb: Tensor, background: Tensor, is_alpha: bool = False
) -> Rendered:
    """Composite densities or alphas, and colours, of packed samples: NeRF, equation 3.

    Args:
        rays: R rays; their far ends are the depth of transparent rays.
        samples: N samples along the rays.
        sigma: (N,) density in 1/length, or the opacity of each interval.
        rgb: (N, 3) colour in [0, 1].
        background: (R, 3) or (3,) colour in [0, 1] of the background.
        is_alpha: whether `sigma` is an opacity, as in NeuS (Wang et al. 2021, equation 13).
    """
    sigma, rgb = at_least_float32(sigma), at_least_float32(rgb)
    over = composite_alpha if is_alpha else composite
    sums: Composited = over(samples, sigma, rgb, background.to(rgb.dtype), rays.fars)
    return Rendered(
        rgb=sums.color,
        depth=mean_distance(sums.moment, sums.opacity.detach(), rays.fars),
        median_depth=sums.median,
        accumulation=sums.opacity,
        num_samples=samples.num_evaluated,
        weights=sums.weights,
        samples=samples,
        error_bound=samples.early_stop,
    )


def mean_distance(moments: Tensor, opacity: Tensor, fars: Tensor) -> Tensor:
    """Return the mean distance (R,) of the light of rays, from weighted sums of distances; `fars` if transparent.

    `moments` (R,) are sums of weight times distance, `opacity` (R,) sums of weights.
    """
    visible = opacity > 1e-6
    mean = moments / torch.where(visible, opacity, torch.ones_like(moments))
    return torch.where(visible, torch.minimum(mean, fars), fars)
