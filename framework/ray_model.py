"""The model of methods that cast rays: a field, a sampler and a renderer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from nerfloom.base.step_kind import StepKind
from nerfloom.cameras.cameras import subpixels
from nerfloom.cameras.view import View
from nerfloom.data.pixels.batch import PixelBatch
from nerfloom.data.scene import Scene
from nerfloom.encodings.coarse_to_fine import OpenLevels
from nerfloom.fields.base import DensityFunction, Field
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.traced.squared_error import PixelTargets, TracedError
from nerfloom.losses.term import LossTerm, RenderedBatch
from nerfloom.losses.terms import COLOR_ERROR, KNOWN_DISTANCES, CoarseColorError, SamplerLoss
from nerfloom.model import Loss, PixelModel, RayConfigT
from nerfloom.renderable import parts
from nerfloom.rendering.light import SQUARED, make_light
from nerfloom.rendering.outputs import Output, empty
from nerfloom.rendering.rendered import Picture, Rendered
from nerfloom.rendering.renderer import Renderer
from nerfloom.rendering.traced import error_of_traced, traced_rays
from nerfloom.rendering.volume import VolumeRenderer
from nerfloom.samplers.base import Sampler, SkipsCells
from nerfloom.samplers.in_view import pixels_in_view
from nerfloom.scene.covisible_space import CovisibleSpace


class RayModel(PixelModel[RayConfigT]):
    """A model that evaluates a field at a sampler's positions and composites the values with a renderer."""

    losses: ClassVar[Sequence[LossTerm]] = (COLOR_ERROR, CoarseColorError(), SamplerLoss(), *KNOWN_DISTANCES)
    """The objective: the sum of the terms that apply to the settings and the batch."""
    steps_repeat: ClassVar[bool] = False
    """True if field, renderer and losses depend on the training step only through values of tensors, so that steps can
    be captured if the sampler's can."""
    plain: ClassVar[bool] = True
    """True if `RayModel.render` is not overridden, so that a native call may replace it. A subclass that does not
    override it says so: `class M(RayModel, plain=True)`."""

    def __init_subclass__(cls, plain: bool = False, **rest: Any) -> None:
        super().__init_subclass__(**rest)
        cls.plain = plain

    def __init__(self, config: RayConfigT, scene: Scene, field: Field, sampler: Sampler, renderer: Renderer) -> None:
        super().__init__(config, scene)
        self.field, self.sampler, self.renderer = field, sampler, renderer
        self.light = make_light(config, scene)
        starts = config.rays_shared_by and scene.unbounded and not scene.warped and not isinstance(sampler, SkipsCells)
        self.covisible_space = CovisibleSpace(scene.box) if starts else None

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        """Render R rays.

        Args:
            rays: the rays, in the frame of the scene; R may be 0.
            background: (R, 3) or (3,) colour in [0, 1] of the background.
        """
        rays = rays if self.covisible_space is None else self.covisible_space(rays)
        samples = self.sampler.sample(rays, self.field, self.training)
        return self.lit(self.renderer.render(rays, samples, self.field, background), rays, background)

    def lit(self, rendered: Rendered, rays: Rays, background: Tensor) -> Rendered:
        """Return rendered values with the colours that the rays' images show (`light`).

        A model that renders further colours may override it.

        Args:
            rendered: R rays with the colours of the scene.
            rays: the rays; their images have the light.
            background: (R, 3) or (3,) colour in [0, 1] of the background, which keeps its colour.
        """
        if self.light is None:
            return rendered
        rgb = self.light.lit(rendered.rgb, rendered.accumulation, background, rays.camera_indices, rays.places)
        lit = replace(rendered, rgb=rgb)
        if rendered.coarse is None:
            return lit
        return replace(lit, extras={**lit.extras, "coarse": self.lit(rendered.coarse, rays, background)})

    def loss(self, batch: PixelBatch, step: int) -> Loss:
        """Return the terms of `losses` on a batch.

        Args:
            batch: pixels with their true colours, and rays in the frame of the scene.
            step: number of training steps done.
        """
        factors = {term: term.factor(self.config, step) for term in self.losses}
        terms = [term for term, factor in factors.items() if factor and term.applies(batch, self)]
        known = self._traced(batch) if terms == [COLOR_ERROR] else None
        if known is not None:
            return Loss({COLOR_ERROR.name: known.error}, known.rgb, known.num_samples)
        rendered = self.render(batch.rays, batch.background.repeat_interleave(batch.rays_per_pixel, 0))
        shown, values = RenderedBatch(batch, rendered, self, step), dict[str, Tensor]()
        for term in terms:
            found, factor = term(shown), factors[term]
            named = found if isinstance(found, dict) else {} if found is None else {term.name: found}
            values |= named if factor == 1 else {name: factor * value for name, value in named.items()}
        if self.light is not None:
            values["appearance"] = SQUARED * self.light.penalty()
        return Loss(values, shown.pixels.rgb.detach(), rendered.num_samples)

    def _traced(self, batch: PixelBatch) -> TracedError | None:
        """Return the mean squared error of a batch's colours if a native call can compute it; else None."""
        if not self.plain or self.light is not None:
            return None
        pixels = PixelTargets(batch.background.repeat_interleave(batch.rays_per_pixel, 0), batch.rgb, batch.weights)
        parts = self.sampler, self.field, self.renderer
        return error_of_traced(batch.rays, pixels, *parts, self.config.thin_gradients)

    @torch.no_grad()
    def render_view(self, view: View, background: Tensor) -> Picture:
        """Render `view` over `background` (3,) in chunks of `eval_num_rays_per_chunk` rays, in evaluation mode.

        Pixels that only show the background (`pixels_in_view`) are not rendered.
        """
        per_pixel, outputs = view.rays_per_pixel or self.rays_per_pixel, self.outputs
        offsets, grid, times = subpixels(per_pixel, self.device), view.pixels(), view.times()
        chunk, count = max(self.rays_at_once // per_pixel, 1), grid.numel()
        pixels, seen = grid.reshape(-1), self._seen(view)
        places = None if seen is None else seen.reshape(-1).nonzero().squeeze(-1)
        # Preallocated: small results between a chunk's large temporaries would fragment the heap.
        rgb, extras = background.to(self.device, torch.float32).repeat(count, 1), empty(outputs, count, self.device)
        depth, median, accumulation = torch.full((3, count), self.scene.far, device=self.device)
        accumulation.zero_()
        with self.rendering():
            for start in range(0, count if places is None else len(places), chunk):
                part: slice | Tensor = slice(start, start + chunk)
                part = part if places is None else places[part]
                rays = view.camera.pixel_rays(pixels[part], self.scene.near, self.scene.far, times, offsets)
                if self.light is not None and self.light.placed:
                    rays = replace(rays, places=view.camera.places(pixels[part], offsets))
                # The view's camera has index 0, which must not stand for a training camera.
                rendered = self.shown(replace(rays, camera_indices=None), background).to_pixels(per_pixel, outputs)
                rgb[part], depth[part], median[part] = rendered.rgb, rendered.depth, rendered.median_depth
                accumulation[part] = rendered.accumulation
                for output in outputs:
                    extras[output.name][part] = output.finished(rendered.extras[output.name])
        size = tuple(grid.shape)
        return Picture(
            rgb.view(*size, 3),
            depth.view(size),
            median.view(size),
            accumulation.view(size),
            {output.name: extras[output.name].view(*size, *output.shape) for output in outputs},
            outputs,
            num_rays=count * per_pixel,
        )

    def shown(self, rays: Rays, background: Tensor) -> Rendered:
        """Render rays of a view as `render` does, but without weights and samples if a native call can render them.

        Args:
            rays: R rays.
            background: (3,) colour in [0, 1].

        Returns:
            The rendered values of R rays.
        """
        known = None
        if self._renders_plainly and self.covisible_space is None:
            known = traced_rays(rays, background, self.sampler, self.field, self.renderer)
        return self.render(rays, background) if known is None else self.lit(known, rays, background)

    def _seen(self, view: View) -> Tensor | None:
        """Return the pixels of a view that may show more than the background; None if unknown."""
        return pixels_in_view(self.sampler, view) if self._renders_plainly else None

    @property
    def _renders_plainly(self) -> bool:
        """True without an overridden `render` or another renderer than `VolumeRenderer`."""
        return self.plain and type(self.renderer) is VolumeRenderer

    def step_kind(self, step: int) -> StepKind:
        if not self.steps_repeat:
            return super().step_kind(step)
        for term in self.losses:
            if (reason := term.varies(self.config)) is not None:
                return StepKind(varies=reason)
        if not all(opening.complete for opening in parts(self, OpenLevels)):
            return StepKind(varies="levels are still opening")
        return self.sampler.step_kind(step)

    def read_counts(self) -> None:
        self.sampler.read_counts()

    def before_step(self, step: int, progress: float) -> None:
        """Open levels of encodings up to `progress`, and update the sampler for `step`."""
        for opening in parts(self, OpenLevels):
            opening.advance(progress)
        self.sampler.update(step, self.grid_density)

    @property
    def grid_density(self) -> DensityFunction:
        """The density that tells the sampler which cells are occupied; the field's."""
        return self.field.density

    def density(self, points: Points) -> Tensor:
        """Return the density (N,) at `points`, in 1/length."""
        return self.field.density(points)[0]

    @property
    def runs_on_kernels(self) -> bool:
        """Return whether the field runs on compiled kernels; torch's own operations then use one CPU thread."""
        return self.field.runs_on_kernels

    @property
    def outputs(self) -> tuple[Output, ...]:
        """Further outputs of the renderer (`Renderer.outputs`)."""
        return self.renderer.outputs

    @property
    def samples_per_step(self) -> int | None:
        """Number of samples per training step, set by the sampler; None for a fixed number of pixels."""
        return self.sampler.samples_per_step
