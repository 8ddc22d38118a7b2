"""A model put together from a field, a sampler and a renderer, which casts rays."""

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
    """A field, asked where a sampler chooses, and shown by a renderer.

    Args:
        config: the method's settings, decided.
        scene: facts about the data.
        field: density and colour.
        sampler: where the field is asked.
        renderer: from samples to what rays show.
    """

    batches: ClassVar[Literal["pixels", "views"]] = "pixels"

    def __init__(self, config: RayConfigT, scene: Scene, field: Field, sampler: Sampler, renderer: Renderer) -> None:
        super().__init__(config, scene)
        self.field, self.sampler, self.renderer = field, sampler, renderer

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        """Return what R rays show.

        Args:
            rays: the rays; R may be 0.
            background: (R, 3) or (3,) colour that shows as far as a ray is not opaque.
        """
        samples = self.sampler.sample(rays, self.field, self.training)
        return self.renderer.render(rays, samples, self.field, background)

    def loss(self, batch: PixelBatch, step: int) -> Loss:
        """Return the squared error of the pixels' colours, what the sampler learns by, and `regularizers`.

        Args:
            batch: pixels with what they should show.
            step: training steps done.
        """
        per_pixel = batch.rays_per_pixel
        rendered = self.render(batch.rays, batch.background.repeat_interleave(per_pixel, 0))
        pixels = rendered.to_pixels(per_pixel)
        terms = {"rgb": mean_squared_error(pixels.rgb, batch.rgb, batch.weights)}
        if rendered.coarse is not None:
            coarse = rendered.coarse.to_pixels(per_pixel)
            terms["rgb_coarse"] = mean_squared_error(coarse.rgb, batch.rgb, batch.weights)
        if rendered.samples is not None and rendered.weights is not None:
            terms |= self.sampler.losses(rendered.samples, rendered.weights)
        terms |= self.regularizers(rendered, batch, step)
        return Loss(terms, pixels.rgb.detach(), rendered.num_samples)

    def regularizers(self, rendered: Rendered, batch: PixelBatch, step: int) -> dict[str, Tensor]:
        """Return further named scalars to be minimised, of rays or of parameters; none by default.

        Args:
            rendered: what the batch's rays showed, before any are averaged to pixels.
            batch: the pixels.
            step: training steps done.
        """
        return {}

    @torch.no_grad()
    def render_view(self, view: View, background: Tensor) -> Picture:
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
                # The camera is no training camera, whose number it must not be taken for.
                shown = self.render(replace(rays, camera_indices=None), background).to_pixels(per_pixel)
                columns.append((shown.rgb, shown.depth, shown.median_depth, shown.accumulation))
                normals += [] if shown.normals is None else [safe_normalize(shown.normals.float())]
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
        self.sampler.update(step, self.field.density)

    def density(self, points: Points) -> Tensor:
        """Return density (N,), 1/length.

        Args:
            points: N points, scene coordinates.
        """
        return self.field.density(points)[0]

    @property
    def runs_on_kernels(self) -> bool:
        return self.field.runs_on_kernels

    @property
    def samples_per_step(self) -> int | None:
        return self.sampler.samples_per_step

    @property
    def rays_per_pixel(self) -> int:
        return self.config.rays_per_pixel
