"""Backgrounds composited behind a method's rendering: NeRF++ (Zhang et al. 2020), section 4, equation 7."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.device import runs_ahead
from nerfloom.data.scene import Scene
from nerfloom.fields.base import Field
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.geometry.spheres import InvertedRays, distances_behind
from nerfloom.rendering.choice import volume_renderer
from nerfloom.rendering.rendered import Rendered
from nerfloom.rendering.renderer import Renderer
from nerfloom.rendering.volume import VolumeRenderer
from nerfloom.samplers.background import BackgroundConfig, foreground_sphere
from nerfloom.samplers.base import Sampler
from nerfloom.samplers.hierarchical import HierarchicalSampler
from nerfloom.samplers.uniform import LAST_INTERVAL, UniformSampler


class SphereRenderer(Renderer):
    """Renders a second field, outside a sphere, behind another renderer's picture.

    The second field is evaluated at points (N, 4) of the inverted sphere (`InvertedRays`). Its density is per unit of
    1/r, as in the authors' code, so that the rays there have a finite length. Its contribution to a colour is weighted
    by the transmittance of the inside. The far end of the last interval is at infinity, so any density there makes the
    ray opaque.

    The outside is the rest of a ray. Where the inside ends rays early, with a transmittance of at most the bound of its
    error, pictures leave out the outside too, within the same bound. In training on a CPU such a ray keeps it with a
    probability, the transmittance relative to the bound, and its colour is then divided by this probability. So colours
    and their gradients have the same expectation (Arvo and Kirk 1990).

    Args:
        renderer: renders the inside, with samples of an `InsideSphere`.
        sphere: (4,) centre and radius, scene units.
        field: density and colour at points of the inverted sphere.
        sampler: chooses samples along inverted rays.
        endless: whether the last interval is endless: for images without an alpha channel, which do not mark
            background.
        thin: samples outside below this fraction of the mean gradient are thinned in training on the CPU; 0 for none.
    """

    sphere: Tensor

    def __init__(
        self,
        renderer: Renderer,
        sphere: Tensor,
        field: Field,
        sampler: Sampler,
        endless: bool,
        thin: float = 0.0,
    ) -> None:
        super().__init__()
        self.renderer, self.field, self.sampler, self.endless = renderer, field, sampler, endless
        self.outputs = renderer.outputs
        self.behind = VolumeRenderer(thin=thin)
        self.register_buffer("sphere", sphere.clone())

    def render(self, rays: Rays, samples: Samples, field: Field, background: Tensor) -> Rendered:
        inside = self.renderer.render(rays, samples, field, torch.zeros_like(background))
        chosen = self._going_on(inside)
        if chosen is None:
            return self._over(rays, inside, background)
        some, chances = chosen
        behind = background if background.dim() == 1 else background[some]
        shown = self._over(rays[some], _of_rays(inside, some), behind, chances)
        return replace(
            inside,
            rgb=inside.rgb.index_copy(0, some, shown.rgb),
            depth=inside.depth.index_copy(0, some, shown.depth),
            median_depth=inside.median_depth.index_copy(0, some, shown.median_depth),
            accumulation=inside.accumulation.index_copy(0, some, shown.accumulation),
            num_samples=shown.num_samples,
        )

    def _over(self, rays: Rays, inside: Rendered, background: Tensor, chances: Tensor | None = None) -> Rendered:
        """Composite the inside of R rays in front of the outside.

        Args:
            rays: the rays themselves.
            inside: the inside before a black background.
            background: (R, 3) or (3,) colour in [0, 1] behind everything.
            chances: (R,) probabilities of the choice of these rays; None for 1.
        """
        inverted = InvertedRays.of(rays, self.sphere)
        outside = self.behind.render(inverted, self._sampled(inverted), self.field, background)
        if chances is not None:
            outside = replace(outside, rgb=outside.rgb / chances[:, None])
        return over_background(inside, outside, lambda u: distances_behind(u, rays, self.sphere))

    @torch.no_grad()
    def _going_on(self, inside: Rendered) -> tuple[Tensor, Tensor | None] | None:
        """Return the rays (K,) that show the outside, and their probabilities (K,) in training; None for all rays."""
        bound, left = inside.error_bound, 1 - inside.accumulation
        if bound <= 0 or inside.coarse is not None:
            return None
        if not self.training:
            return (left > bound).nonzero().squeeze(-1), None
        if runs_ahead(left.device):  # it would have to be waited for
            return None
        chances = (left / bound).clamp(0, 1)
        some = (torch.rand_like(chances) < chances).nonzero().squeeze(-1)
        return some, chances[some]

    def _sampled(self, rays: InvertedRays) -> Samples:
        """Return samples of inverted rays; they are transparent on rays that end before the sphere."""
        samples = self.sampler.sample(rays, self.field, self.training)
        ends = torch.where(rays.fars > rays.nears, LAST_INTERVAL, rays.nears) if self.endless else rays.fars
        if samples.coarse is not None:
            samples = replace(samples, coarse=replace(samples.coarse, samples=_ending_at(samples.coarse.samples, ends)))
        return _ending_at(samples, ends)


def _of_rays(inside: Rendered, some: Tensor) -> Rendered:
    """Return the values of `some` (K,) of the rays, without further values; samples and weights of all rays stay."""
    parts = (inside.rgb, inside.depth, inside.median_depth, inside.accumulation)
    rgb, depth, median, opacity = (values.index_select(0, some) for values in parts)
    return replace(inside, rgb=rgb, depth=depth, median_depth=median, accumulation=opacity, extras={})


def over_background(inside: Rendered, outside: Rendered, distances: Callable[[Tensor], Tensor]) -> Rendered:
    """Composite R rays: the inside in front of the outside.

    Samples, weights and further values describe the inside.

    Args:
        inside: the inside before a black background.
        outside: the outside before the background, with the same number of samples on each ray.
        distances: function from positions (R,) on the rays of `outside`, one each, to distances along the rays of
            `inside`.
    """
    left = 1 - inside.accumulation
    accumulation = inside.accumulation + left * outside.accumulation
    with torch.no_grad():
        share = torch.where(accumulation > 1e-6, inside.accumulation / accumulation, 1.0)  # of the visible light
        depth = torch.lerp(distances(outside.depth), inside.depth, share)
        median = torch.where(inside.accumulation >= 0.5, inside.median_depth, distances(_median(outside, left)))
    extras = dict(inside.extras)
    if inside.coarse is not None or outside.coarse is not None:
        levels = [level.coarse or replace(level, extras={}) for level in (inside, outside)]
        extras["coarse"] = over_background(levels[0], levels[1], distances)
    return replace(
        inside,
        rgb=inside.rgb + left[:, None] * outside.rgb,
        depth=depth,
        median_depth=median,
        accumulation=accumulation,
        num_samples=inside.num_samples + outside.num_samples,
        extras=extras,
    )


def _median(outside: Rendered, left: Tensor) -> Tensor:
    """Return the position (R,) of the first outside sample with a transmittance of at most 0.5 behind it.

    Args:
        outside: the outside, with the same number of samples on each ray.
        left: (R,) transmittance of the inside.
    """
    assert outside.samples is not None
    assert outside.weights is not None
    behind = left[:, None] * (1 - outside.samples.padded(outside.weights).cumsum(-1))
    past = behind <= 0.5
    places = torch.where(past, outside.samples.padded(outside.samples.t), 1.0)
    return places.amin(-1)


def background_renderer(
    config: BackgroundConfig,
    scene: Scene,
    make_field: Callable[[Any, Scene], Field],
    renderer: Renderer | None = None,
) -> Renderer:
    """Return a renderer with a background if the settings have a sphere.

    With hierarchical sampling, the outside is also sampled hierarchically, with its own coarse field and equal numbers
    of samples. Otherwise it is sampled uniformly in 1/r.

    Args:
        scene: properties of the whole scene, not of its foreground.
        make_field: creates a field for the outside, from settings and scene.
        renderer: renders the inside; if None, `volume_renderer`'s.
    """
    renderer = renderer or volume_renderer(config, scene)
    if config.background_model != "sphere":
        return renderer
    sampler: Sampler = UniformSampler(config.num_background_samples)
    if str(config.sampler) == "hierarchical":
        coarse = make_field(config, scene)
        sampler = HierarchicalSampler(coarse, config.num_coarse_samples, config.num_fine_samples)
    field, endless, thin = make_field(config, scene), not scene.has_alpha, config.thin_gradients
    return SphereRenderer(renderer, foreground_sphere(config, scene), field, sampler, endless, thin)


def _ending_at(samples: Samples, ends: Tensor) -> Samples:
    """Return samples with the last intervals ending at `ends` (R,); each ray has the same number of samples."""
    changed = samples.padded(samples.t_ends).clone()
    changed[:, -1] = ends
    return replace(samples, t_ends=changed.view(-1), points=samples.t)
