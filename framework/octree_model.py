"""A model of an octree that learns its leaves from photographs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

from nerfloom.base.config import AT_LEAST_0, Range, RayConfig
from nerfloom.base.optimised import Optimised
from nerfloom.data.pixels.batch import PixelBatch
from nerfloom.data.scene import Scene
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.adam.row_gradient import RowGradient
from nerfloom.kernels.dispatch import CPP
from nerfloom.kernels.octree.layout import OctreeLayout
from nerfloom.kernels.octree.light import MAX_DEGREE, OctreeLight, depths_of, error_bound
from nerfloom.kernels.octree.trace import trace_octree
from nerfloom.losses.functions import mean_squared_error
from nerfloom.model import Loss, Model
from nerfloom.octrees.drawn import DrawsOctree

STOP = 1e-2
"""Transmittance below which rays end in training."""


@dataclass(frozen=True)
class OctreeConfig(
    RayConfig,
    num_rays_per_batch=32_768,
    steps_per_ray=0.0,
    learning_rate=0.02,
    lr_schedule="exponential",
    lr_final=0.1,
    adam_beta2=0.99,
    depth_loss_mult=0.0,
    samples_per_batch=None,
    appearance="none",
):
    """Settings of learning an octree's leaves."""

    RANGES: ClassVar[dict[str, Range]] = {"density_rate": AT_LEAST_0, "degree": (0, MAX_DEGREE)}
    """Allowed ranges."""
    density_rate: float = 5.0
    """Learning rate of densities, relative to that of colours."""
    degree: int = 1
    """Degree of the harmonics of colours, 0 to 3."""


class LeafTable(nn.Module):
    """Learnt values of the leaves.

    Args:
        name: name of the learning rate in logs.
        rate: learning rate.
        width: number of values of a leaf.
    """

    def __init__(self, name: str, rate: float, width: int) -> None:
        super().__init__()
        self.table = nn.Parameter(torch.zeros(0, width))
        self.deferred = RowGradient() if CPP.available() else None
        self.optimised = Optimised(name, rate, sparse=True)


class OctreeModel(Model[OctreeConfig], DrawsOctree):
    """An octree with learnt density and colour; `set_octree` sets the positions of its leaves.

    Args:
        config: the settings.
        scene: the scene.
    """

    batches: ClassVar[Literal["pixels", "views"]] = "pixels"

    def __init__(self, config: OctreeConfig, scene: Scene) -> None:
        super().__init__(config, scene)
        self.densities = LeafTable("densities", config.density_rate * config.learning_rate, 1)
        self.colors = LeafTable("colors", config.learning_rate, 3 * (config.degree + 1) ** 2)
        cells = torch.zeros(0, 3, dtype=torch.int64)
        self.layout = OctreeLayout.build(scene.box[0].cpu(), 1.0, (1, 1, 1), cells)[0]

    def set_octree(self, layout: OctreeLayout, raw: Tensor, coefficients: Tensor) -> None:
        """Set the leaves and their values.

        Args:
            layout: where the L leaves are.
            raw: (L, 1) raw densities, as in `trace_octree`.
            coefficients: (L, 3 K) coefficients of the leaves.
        """
        self.layout = layout
        self.densities.table.data, self.colors.table.data = raw.contiguous(), coefficients.contiguous()

    def depths(self) -> Tensor:
        """Return the optical depth (L,) of a cell's edge in each leaf, without gradient."""
        return depths_of(self.densities.table.detach()[:, 0])

    def light(self, rays: Rays, background: Tensor, stop: float) -> OctreeLight:
        density, color = self.densities, self.colors
        deferred = None
        if density.deferred is not None and color.deferred is not None:
            deferred = density.deferred, color.deferred
        stop = STOP if self.training else stop
        return trace_octree(self.layout, density.table, color.table, rays, background, stop, deferred)

    @property
    def largest(self) -> float:
        return max(error_bound(self.colors.table.detach(), 1.0), 1.0) if not self.training else 1.0

    def loss(self, batch: PixelBatch, step: int) -> Loss:
        rendered = self.render(batch.rays, batch.background.repeat_interleave(batch.rays_per_pixel, 0))
        rgb = rendered.to_pixels(batch.rays_per_pixel).rgb
        return Loss({"rgb": mean_squared_error(rgb, batch.rgb, batch.weights)}, rgb.detach())

    @property
    def runs_on_kernels(self) -> bool:
        """Return True, so that torch's own operations use one CPU thread."""
        return True
