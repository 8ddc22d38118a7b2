"""The model of methods that cast rays: a field, a sampler and a renderer."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Generic, Literal, TypeVar

import torch
from torch import Tensor

from nerfloom.base.config import RayConfig
from nerfloom.base.step_kind import StepKind
from nerfloom.cameras.cameras import subpixels
from nerfloom.cameras.refinement import PoseRefinement
from nerfloom.cameras.unseen import unseen_patches
from nerfloom.cameras.view import View
from nerfloom.data.pixels import PixelBatch, thinned
from nerfloom.data.scene import Scene
from nerfloom.encodings.opening import Opening
from nerfloom.fields.base import Field
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.math import safe_normalize
from nerfloom.kernels.native import torch_on_one_thread
from nerfloom.kernels.traced_error import PixelTargets, TracedError
from nerfloom.model import Loss, Model, evaluating, parts
from nerfloom.rendering.losses import (
    density_before,
    depth_error,
    depth_roughness,
    distance_likelihood,
    matter_before,
    mean_squared_error,
    opacity_of_transparent,
)
from nerfloom.rendering.rendered import Picture, Rendered
from nerfloom.rendering.renderer import Renderer
from nerfloom.rendering.traced import error_of_traced, traced_rays
from nerfloom.rendering.volume import VolumeRenderer
from nerfloom.samplers.base import Sampler, SkipsCells
from nerfloom.samplers.in_view import pixels_in_view
from nerfloom.scene.few_images import FewImagesConfig, unseen_weight
from nerfloom.scene.motion import MotionConfig
from nerfloom.scene.shared_space import SharedSpace

RayConfigT = TypeVar("RayConfigT", bound=RayConfig)
PATCH = 8
"""Rays along the edge of a patch of an unseen view, as in RegNeRF (Niemeyer et al. 2022)."""
PATCH_IMAGE = 500
"""Longer side of an image, pixels, in which neighbouring rays of a patch are a pixel apart; in larger ones, as far in
relation to the image."""

PLAIN = "render", "color_error"
"""Methods that a model must have from here for its loss to be learnt in one call."""


class RayModel(Model[RayConfigT], Generic[RayConfigT]):
    """A model that evaluates a field at the positions of a sampler and composites the values with a renderer.

    Args:
        config: the method's settings, decided.
        scene: properties of the scene.
        field: density and colour.
        sampler: chooses the positions along each ray.
        renderer: turns samples into colours and depths.
    """

    batches: ClassVar[Literal["pixels", "views"]] = "pixels"
    coarse_weight: ClassVar[float] = 1.0
    """Weight of the loss of a coarse level that is supervised too."""
    steps_repeat: ClassVar[bool] = False
    """True if field, renderer and `loss` depend on the training step by the values of tensors alone, so that steps can
    be recorded wherever the sampler's can."""

    def __init__(self, config: RayConfigT, scene: Scene, field: Field, sampler: Sampler, renderer: Renderer) -> None:
        super().__init__(config, scene)
        self.field, self.sampler, self.renderer = field, sampler, renderer
        self.poses: PoseRefinement | None = None
        """Refinement of the training cameras' poses; None if they stay as they are."""
        starts = config.rays_shared_by and scene.unbounded and not scene.warped and not isinstance(sampler, SkipsCells)
        self.shared_space = SharedSpace(scene.box) if starts else None

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        """Render R rays.

        Args:
            rays: the rays; R may be 0.
            background: (R, 3) or (3,) colour in [0, 1] of the background.
        """
        rays = rays if self.poses is None else self.poses(rays)
        rays = rays if self.shared_space is None else self.shared_space(rays)
        samples = self.sampler.sample(rays, self.field, self.training)
        return self.renderer.render(rays, samples, self.field, background)

    def loss(self, batch: PixelBatch, step: int) -> Loss:
        """Return the error of the pixels' colours (`color_error`), that of depths, the sampler's, and `regularizers`.

        Args:
            batch: pixels with their true colours.
            step: number of training steps done.
        """
        known = self._traced(batch)
        if known is not None:
            return Loss({"rgb": known.error}, known.rgb, known.num_samples)
        drawn, config = batch, self.config
        moves = isinstance(config, MotionConfig) and self.scene.moving and batch.alpha is not None
        if isinstance(config, MotionConfig) and moves and config.transparent_share < 1:
            batch, kept = thinned(batch, config.transparent_share)
        per_pixel = batch.rays_per_pixel
        rendered = self.render(batch.rays, batch.background.repeat_interleave(per_pixel, 0))
        pixels = rendered.to_pixels(per_pixel)
        terms = {"rgb": self.color_error(pixels.rgb, batch)}
        if rendered.coarse is not None:
            coarse = rendered.coarse.to_pixels(per_pixel)
            terms["rgb_coarse"] = self.coarse_weight * self.color_error(coarse.rgb, batch)
        if rendered.samples is not None and rendered.weights is not None:
            terms |= self.sampler.losses(rendered.samples, rendered.weights)
        terms |= self._depth_terms(rendered, batch)
        terms |= self.regularizers(rendered, batch, step)
        if isinstance(self.config, FewImagesConfig):
            terms |= self._for_few_images(self.config, rendered, batch, step)
        if isinstance(config, MotionConfig) and moves and config.empty_loss_mult and batch.alpha is not None:
            wrong = opacity_of_transparent(pixels.accumulation, batch.alpha, batch.weights)
            terms["empty"] = config.empty_loss_mult * wrong
        rgb = pixels.rgb.detach()
        if batch is not drawn:  # of what was left out it is known that nothing is before the background
            rgb = drawn.rgb.index_copy(0, kept, rgb.to(drawn.rgb))
        return Loss(terms, rgb, rendered.num_samples)

    def _traced(self, batch: PixelBatch) -> TracedError | None:
        """Return the loss of a batch if it is the error of colours alone and known in one call; None otherwise."""
        config = self.config
        own = all(getattr(getattr(self, name), "__func__", None) is getattr(RayModel, name) for name in PLAIN)
        few = isinstance(config, FewImagesConfig) and (config.occlusion_loss_mult or config.unseen_loss_mult)
        depths = batch.distances is not None and config.depth_loss_mult > 0
        others = type(self.sampler).losses is not Sampler.losses or isinstance(config, MotionConfig)
        others = others or self._has_regularizers() or self.poses is not None
        if not own or few or depths or others or batch.clear is not None:
            return None
        pixels = PixelTargets(batch.background.repeat_interleave(batch.rays_per_pixel, 0), batch.rgb, batch.weights)
        return error_of_traced(batch.rays, pixels, self.sampler, self.field, self.renderer, config.thin_gradients)

    def _depth_terms(self, rendered: Rendered, batch: PixelBatch) -> dict[str, Tensor]:
        """Return the losses of what is known of distances, of both levels, and of space that is known to be empty."""
        terms: dict[str, Tensor] = {}
        for name, level in (("depth", rendered), ("depth_coarse", rendered.coarse)):
            if self.config.depth_loss_mult > 0 and level is not None:
                error = depth_loss(level, batch)
                terms |= {} if error is None else {name: self.config.depth_loss_mult * error}
        if batch.clear is not None and rendered.samples is not None and rendered.weights is not None:
            clear = batch.clear.repeat_interleave(batch.rays_per_pixel)
            matter = matter_before(rendered.weights, rendered.samples, clear)
            terms["free_space"] = self.config.free_space_loss_mult * matter
        return terms

    def color_error(self, rgb: Tensor, batch: PixelBatch) -> Tensor:
        """Return the error () of colours; the mean of squares by default.

        Args:
            rgb: (R, 3) rendered colours of the batch's pixels.
            batch: the pixels, with their colours and weights.
        """
        return mean_squared_error(rgb, batch.rgb, batch.weights)

    def regularizers(self, rendered: Rendered, batch: PixelBatch, step: int) -> dict[str, Tensor]:
        """Return further terms of the loss by name, each a scalar; none by default.

        Args:
            rendered: the rendered rays of the batch, before they are averaged to pixels.
            batch: the pixels.
            step: number of training steps done.
        """
        return {}

    @property
    def regularized(self) -> bool:
        """Return whether `regularizers` may return terms.

        Of a class that overrides `regularizers` and not this, it is taken to be so.
        """
        return False

    def _has_regularizers(self) -> bool:
        says, returns = (
            next(base for base in type(self).__mro__ if name in vars(base)) for name in ("regularized", "regularizers")
        )
        return self.regularized or not issubclass(says, returns) or "regularizers" in vars(self)

    def _for_few_images(
        self, config: FewImagesConfig, rendered: Rendered, batch: PixelBatch, step: int
    ) -> dict[str, Tensor]:
        """Return the terms of the loss that replace images where there are few (`nerfloom.scene.few_images`)."""
        losses, poses = dict[str, Tensor](), self.scene.camera_to_worlds
        if config.occlusion_loss_mult:
            near = config.occlusion_range * self.scene.near
            levels = [level.samples for level in (rendered, rendered.coarse) if level is not None]
            before = [density_before(s, near) for s in levels if s is not None and s.sigma is not None]
            losses |= {"occlusion": config.occlusion_loss_mult * torch.stack(before).sum()} if before else {}
        if config.unseen_loss_mult and len(batch) and poses is not None:
            rays = batch.rays[:: batch.rays_per_pixel][: config.unseen_patches]
            stride = max(self.scene.image_size / PATCH_IMAGE, 1.0)
            shown = self.render(unseen_patches(rays, poses, PATCH, stride), batch.background[0])
            if shown.weights is not None and shown.samples is not None:
                rough = depth_roughness(shown.weights, shown.samples, PATCH)
                losses["unseen"] = unseen_weight(config, step) * rough
        return losses

    @torch.no_grad()
    def render_view(self, view: View, background: Tensor) -> Picture:
        """Render `view` over `background` (3,) in chunks of `eval_num_rays_per_chunk` rays, in evaluation mode.

        Pixels that are known to show the background alone (`pixels_in_view`) are not rendered.
        """
        per_pixel = view.rays_per_pixel or self.rays_per_pixel
        offsets, grid, times = subpixels(per_pixel, self.device), view.pixels(), view.times()
        chunk, count = max(self.config.eval_num_rays_per_chunk // per_pixel, 1), grid.numel()
        pixels, seen = grid.reshape(-1), self._seen(view)
        places = None if seen is None else seen.reshape(-1).nonzero().squeeze(-1)
        # Written into as they come: small results kept between a chunk's large ones would break up the heap.
        rgb, normals = background.to(self.device, torch.float32).repeat(count, 1), None
        depth, median, accumulation = torch.full((3, count), self.scene.far, device=self.device)
        accumulation.zero_()
        with (
            evaluating(self),
            torch_on_one_thread(self.runs_on_kernels),
            torch.autocast(self.device.type, torch.bfloat16, enabled=self.uses_bfloat16),
        ):
            for start in range(0, count if places is None else len(places), chunk):
                part: slice | Tensor = slice(start, start + chunk)
                part = part if places is None else places[part]
                rays = view.camera.pixel_rays(pixels[part], self.scene.near, self.scene.far, times, offsets)
                # Index 0 of the view's one camera must not be taken for the index of a training camera.
                rendered = self.shown(replace(rays, camera_indices=None), background).to_pixels(per_pixel)
                rgb[part], depth[part], median[part] = rendered.rgb, rendered.depth, rendered.median_depth
                accumulation[part] = rendered.accumulation
                if rendered.normals is not None:
                    normals = torch.zeros_like(rgb) if normals is None else normals
                    normals[part] = safe_normalize(rendered.normals.float())
        size = tuple(grid.shape)
        return Picture(
            rgb.view(*size, 3),
            depth.view(size),
            median.view(size),
            accumulation.view(size),
            None if normals is None else normals.view(*size, 3),
            num_rays=count * per_pixel,
        )

    def shown(self, rays: Rays, background: Tensor) -> Rendered:
        """Return rays of a view as `render` does, without weights and samples where one call knows the rest.

        Args:
            rays: R rays.
            background: (3,) colour in [0, 1].

        Returns:
            What R rays show.
        """
        known = None
        if self._renders_plainly and self.shared_space is None:
            known = traced_rays(rays, background, self.sampler, self.field, self.renderer)
        return self.render(rays, background) if known is None else known

    def _seen(self, view: View) -> Tensor | None:
        """Return the pixels of a view that may show anything but the background; None if that is not known."""
        return pixels_in_view(self.sampler, view) if self._renders_plainly else None

    @property
    def _renders_plainly(self) -> bool:
        """Whether `render` and the renderer are those from here, and rays those of the view."""
        own = getattr(self.render, "__func__", None) is RayModel.render
        return own and self.poses is None and type(self.renderer) is VolumeRenderer

    def step_kind(self, step: int) -> StepKind:
        config = self.config
        if not self.steps_repeat:
            return super().step_kind(step)
        if isinstance(config, MotionConfig) and self.scene.moving and config.transparent_share < 1:
            return StepKind(varies="transparent pixels are left out at random")
        if isinstance(config, FewImagesConfig) and config.unseen_loss_mult:
            return StepKind(varies="the weight of unseen views changes from step to step")
        if not all(opening.complete for opening in parts(self, Opening)):
            return StepKind(varies="levels are still opening")
        return self.sampler.step_kind(step)

    def read_counts(self) -> None:
        self.sampler.read_counts()

    def before_step(self, step: int, progress: float) -> None:
        """Open levels of encodings up to `progress`, and update the sampler for `step`."""
        if isinstance(self.config, FewImagesConfig) and self.config.open_levels_until:
            for opening in parts(self, Opening):
                opening.open(progress / self.config.open_levels_until)
        self.sampler.update(step, self.field.density)

    def density(self, points: Points) -> Tensor:
        """Return the density (N,) at `points`, in 1/length."""
        return self.field.density(points)[0]

    @property
    def runs_on_kernels(self) -> bool:
        """Return whether the field runs on compiled kernels; torch's own operations then use one CPU thread."""
        return self.field.runs_on_kernels

    @property
    def samples_per_step(self) -> int | None:
        """Number of samples per training step, as the sampler sets it; None for a fixed number of pixels."""
        return self.sampler.samples_per_step

    @property
    def rays_per_pixel(self) -> int:
        """Number of rays that are averaged for each pixel of an image, as configured."""
        return self.config.rays_per_pixel


def depth_loss(rendered: Rendered, batch: PixelBatch) -> Tensor | None:
    """Return the loss () of the distances that are known of some pixels; None without samples, or if none is known.

    Args:
        rendered: the rays of the batch.
        batch: the pixels.
    """
    weights, samples = rendered.weights, rendered.samples
    if batch.distances is None or samples is None or weights is None or not samples.num_rays:
        return None
    known = batch.distances.repeat_interleave(batch.rays_per_pixel)
    if batch.deviations is None:
        return depth_error(weights, samples, known)
    return distance_likelihood(weights, samples, known, batch.deviations.repeat_interleave(batch.rays_per_pixel))
