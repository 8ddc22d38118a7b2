"""Soft discs: whole images drawn from a few round spots in space, front to back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

from nerfloom import Loss, Method, Model, Optimised, Picture, Scene, TrainConfig, View, ViewBatch


@dataclass(frozen=True)
class DiscConfig(TrainConfig, max_num_iterations=2_000, learning_rate=1e-2):
    """Settings of soft discs."""

    num_discs: int = 64
    """How many there are."""


class Discs(Model[DiscConfig]):
    """K discs that always face the camera, their opacity falling off as a Gaussian."""

    batches: ClassVar[Literal["pixels", "views"]] = "views"

    def __init__(self, config: DiscConfig, scene: Scene) -> None:
        super().__init__(config, scene)
        size = scene.box[1] - scene.box[0]
        self.centers = nn.Parameter(scene.box[0] + torch.rand(config.num_discs, 3) * size)
        self.log_radii = nn.Parameter(torch.full((config.num_discs,), float(size.mean().log()) - 2.5))
        self.colors = nn.Parameter(torch.zeros(config.num_discs, 3))
        self.opacities = nn.Parameter(torch.full((config.num_discs,), -1.0))
        self.optimised = Optimised("discs", schedule="exponential")

    def loss(self, batch: ViewBatch, step: int) -> Loss:
        picture = self.draw(batch.view, batch.background)
        return Loss({"rgb": (picture.rgb - batch.rgb).square().mean()}, picture.rgb.detach())

    @torch.no_grad()
    def render_view(self, view: View, background: Tensor) -> Picture:
        return self.draw(view, background)

    def draw(self, view: View, background: Tensor) -> Picture:
        """Return the picture of a view, with a gradient.

        Args:
            view: one pinhole camera.
            background: (3,) behind all discs.
        """
        camera, far = view.camera, torch.tensor(self.scene.far)
        columns, rows, in_front = camera.project(self.centers, 0)
        distances = (self.centers - camera.camera_to_worlds[0, :, 3]).norm(dim=-1)
        order = distances.argsort()
        flat = view.pixels()
        width = int(camera.widths[0])
        across = (flat % width)[..., None] - columns[order], (flat // width)[..., None] - rows[order]
        radii = camera.fx[0] * (self.log_radii.exp() / distances)[order]
        falloff = torch.exp(-(across[0] ** 2 + across[1] ** 2) / (2 * radii**2))
        alpha = 0.99 * torch.sigmoid(self.opacities[order]) * in_front[order] * falloff
        in_front_of = torch.cumprod(torch.cat([torch.ones_like(alpha[..., :1]), 1 - alpha], -1), -1)
        weights = in_front_of[..., :-1] * alpha
        opacity = weights.sum(-1)
        rgb = weights @ torch.sigmoid(self.colors[order]) + (1 - opacity)[..., None] * background
        depth = torch.where(opacity > 1e-6, (weights @ distances[order]) / opacity.clamp(min=1e-6), far)
        half = (in_front_of[..., 1:] <= 0.5).float()
        median = torch.where(half.any(-1), distances[order][half.argmax(-1)], far)
        return Picture(rgb, depth, median, opacity)


METHOD = Method(DiscConfig(), paper="none", model=Discs)
