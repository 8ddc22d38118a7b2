"""The model of methods that cast rays: a field, a sampler and a renderer."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Generic, Literal, TypeVar

import torch
from torch import Tensor

from framework.base.config import RayConfig
from framework.cameras.cameras import subpixels
from framework.cameras.view import View
from framework.data.pixels import PixelBatch
from framework.data.scene import Scene
from framework.fields.base import Field
from framework.geometry.points import Points
from framework.geometry.rays import Rays
from framework.kernels.math import safe_normalize
from framework.kernels.native import torch_on_one_thread
from framework.model import Loss, Model
from framework.rendering.losses import mean_squared_error
from framework.rendering.rendered import Picture, Rendered
from framework.rendering.renderer import Renderer
from framework.samplers.base import Sampler

RayConfigT = TypeVar("RayConfigT", bound=RayConfig)


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

    def __init__(self, config: RayConfigT, scene: Scene, field: Field, sampler: Sampler, renderer: Renderer) -> None:
        super().__init__(config, scene)
        self.field, self.sampler, self.renderer = field, sampler, renderer

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        """Render R rays.

        Args:
            rays: the rays; R may be 0.
            background: (R, 3) or (3,) colour in [0, 1] of the background.
        """
        samples = self.sampler.sample(rays, self.field, self.training)
        return self.renderer.render(rays, samples, self.field, background)

    def loss(self, batch: PixelBatch, step: int) -> Loss:
        """Return the error of the pixels' colours (`color_error`), the losses of the sampler, and `regularizers`.

        Args:
            batch: pixels with their true colours.
            step: number of training steps done.
        """
        per_pixel = batch.rays_per_pixel
        rendered = self.render(batch.rays, batch.background.repeat_interleave(per_pixel, 0))
        pixels = rendered.to_pixels(per_pixel)
        terms = {"rgb": self.color_error(pixels.rgb, batch)}
        if rendered.coarse is not None:
            coarse = rendered.coarse.to_pixels(per_pixel)
            terms["rgb_coarse"] = self.coarse_weight * self.color_error(coarse.rgb, batch)
        if rendered.samples is not None and rendered.weights is not None:
            terms |= self.sampler.losses(rendered.samples, rendered.weights)
        terms |= self.regularizers(rendered, batch, step)
        return Loss(terms, pixels.rgb.detach(), rendered.num_samples)

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

    @torch.no_grad()
    def render_view(self, view: View, background: Tensor) -> Picture:
        """Render `view` over `background` (3,) in chunks of `eval_num_rays_per_chunk` rays, in evaluation mode."""
        was_training, per_pixel = self.training, view.rays_per_pixel or self.rays_per_pixel
        offsets, grid, times = subpixels(per_pixel), view.pixels(), view.times()
        chunk = max(self.config.eval_num_rays_per_chunk // per_pixel, 1)
        self.eval()
        columns: list[tuple[Tensor, ...]] = []
        normals: list[Tensor] = []
        with (
            torch_on_one_thread(self.runs_on_kernels),
            torch.autocast(self.device.type, torch.bfloat16, enabled=self.uses_bfloat16),
        ):
            for pixels in grid.reshape(-1).split(chunk):
                rays = view.camera.pixel_rays(pixels, self.scene.near, self.scene.far, times, offsets)
                # Index 0 of the view's one camera must not be taken for the index of a training camera.
                rendered = self.render(replace(rays, camera_indices=None), background).to_pixels(per_pixel)
                columns.append((rendered.rgb, rendered.depth, rendered.median_depth, rendered.accumulation))
                normals += [] if rendered.normals is None else [safe_normalize(rendered.normals.float())]
        self.train(was_training)
        rgb, depth, median, accumulation = (torch.cat(column).float() for column in zip(*columns, strict=True))
        return Picture(
            rgb.view(*grid.shape, 3),
            depth.view(grid.shape),
            median.view(grid.shape),
            accumulation.view(grid.shape),
            torch.cat(normals).view(*grid.shape, 3) if normals else None,
            num_rays=grid.numel() * per_pixel,
        )

    def before_step(self, step: int, progress: float) -> None:
        """Update the sampler for `step`; `progress` is not used."""
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
