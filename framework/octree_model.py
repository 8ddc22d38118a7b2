"""A model of an octree that learns its leaves from photographs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor, nn

from nerfloom.base.config import Range, RayConfig
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
from nerfloom.model import Loss, PixelModel
from nerfloom.octrees.drawn import RAYS_AT_ONCE, DrawsOctree
from nerfloom.octrees.growth import UNMET

STOP = 1e-2
"""Rays end below this transmittance in training."""


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
    eval_num_rays_per_chunk=RAYS_AT_ONCE,
    appearance="none",
):
    """Settings of learning an octree's leaves."""

    RANGES: ClassVar[dict[str, Range]] = {"degree": (0, MAX_DEGREE)}
    degree: int = 1
    """Degree of the harmonics of colours, 0 to 3."""

    density_rate = 5.0
    """Learning rate of densities, relative to the rate of colours."""
    images_per_batch = 2
    """Number of images with the rays of a step. Neighbouring rays meet leaves that are close together in memory, and a
    leaf of about a pixel is met by about one ray of a step, from whichever image."""


OctreeConfigT = TypeVar("OctreeConfigT", bound=OctreeConfig)
OctreeModelT = TypeVar("OctreeModelT", bound="OctreeModel[Any]")


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

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: object) -> None:
        saved = state_dict.get(prefix + "table")
        if saved is not None and saved.ndim == 2 and saved.shape[1] == self.table.shape[1]:
            self.table.data = self.table.new_zeros(saved.shape)
        super()._load_from_state_dict(state_dict, prefix, *rest)


class OctreeModel(PixelModel[OctreeConfigT], DrawsOctree):
    """An octree with learnt density and colour; `set_octree` sets the positions of its leaves.

    Args:
        config: the settings.
        scene: the scene.
    """

    frame: Tensor
    """(4,) corner of the first cell, and a cell's edge, scene units."""
    bricks: Tensor
    """(3,) int64 number of bricks along each axis."""
    cells: Tensor
    """(L, 3) int32 coordinates of the leaves, in cells and in the layout's order."""
    peaks: Tensor | None
    """(L,) largest weight of each leaf on training rays since leaves were set, `UNMET` for none; None if nothing needs
    it."""

    def __init__(self, config: OctreeConfigT, scene: Scene) -> None:
        super().__init__(config, scene)
        self.densities = LeafTable("densities", config.density_rate * config.learning_rate, 1)
        self.colors = LeafTable("colors", config.learning_rate, 3 * (config.degree + 1) ** 2)
        self.register_buffer("frame", torch.cat([scene.box[0].cpu().float(), torch.ones(1)]))
        self.register_buffer("bricks", torch.ones(3, dtype=torch.int64))
        self.register_buffer("cells", torch.zeros(0, 3, dtype=torch.int32))
        self.register_buffer("peaks", None)
        self._layout = OctreeLayout.build(self.frame[:3], 1.0, (1, 1, 1), self.cells.long())[0]
        self._largest: float | None = None
        self.register_load_state_dict_post_hook(lambda module, _: module.find_leaves())

    # -- the leaves -------------------------------------------------------------------------------------------

    @property
    def layout(self) -> OctreeLayout:
        if self._layout.origin.device != self.cells.device:
            self._layout = self._layout.to(self.cells.device)
        return self._layout

    def set_octree(self, layout: OctreeLayout, raw: Tensor, coefficients: Tensor) -> None:
        """Set the leaves and their values.

        Args:
            layout: where the L leaves are. Checkpoints hold no coarser levels.
            raw: (L, 1) raw densities, as in `trace_octree`.
            coefficients: (L, 3 K) coefficients of the leaves.
        """
        self.set_layout(layout)
        self.densities.table.data, self.colors.table.data = raw.contiguous(), coefficients.contiguous()

    def set_layout(self, layout: OctreeLayout) -> None:
        """Set where the leaves are; the rows of their values must follow.

        Args:
            layout: where the L leaves are.
        """
        self._layout, self._largest = layout, None
        self.frame = torch.cat([layout.origin, layout.origin.new_tensor([layout.cell])])
        self.bricks = torch.tensor(layout.size, device=layout.origin.device)
        self.cells = layout.cells().int()
        if self.peaks is not None:
            self.peaks = self.frame.new_full((layout.num_leaves,), UNMET)

    def find_leaves(self) -> None:
        """Construct the layout from the buffers, after these were loaded.

        Raises:
            ValueError: if they do not describe an octree, or the number of rows of values differs from the number of
                leaves.
        """
        self._largest = None
        edge, counts = float(self.frame[3]), self.bricks.tolist()
        tables = self.densities.table, self.colors.table, self.peaks
        if any(values is not None and len(values) != len(self.cells) for values in tables):
            raise ValueError(f"there are {len(self.cells):,} leaves, and values of other numbers of leaves")
        if not bool(self.frame.isfinite().all()) or not edge > 0:
            raise ValueError("the frame of the leaves is not finite, or their edge is not positive")
        self._layout, order = OctreeLayout.build(self.frame[:3], edge, counts, self.cells.long())
        if not torch.equal(order, torch.arange(len(self.cells), device=order.device)):
            raise ValueError("the leaves are not in order")

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        for name in ("cells", "peaks"):
            saved, own = state_dict.get(prefix + name), getattr(self, name)
            if saved is not None and own is not None and saved.ndim == own.ndim and saved.shape[1:] == own.shape[1:]:
                setattr(self, name, own.new_zeros(saved.shape))
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def depths(self, leaves: Tensor | None = None) -> Tensor:
        raw = self.densities.table.detach()[:, 0]
        return depths_of(raw if leaves is None else raw[leaves])

    def coefficients(self) -> Tensor:
        return self.colors.table.detach()

    # -- light ------------------------------------------------------------------------------------------------

    def light(self, rays: Rays, background: Tensor, stop: float) -> OctreeLight:
        density, color = self.densities, self.colors
        deferred = None
        if density.deferred is not None and color.deferred is not None:
            deferred = density.deferred, color.deferred
        stop, peaks = (STOP, self.peaks) if self.training else (stop, None)
        return trace_octree(self.layout, density.table, color.table, rays, background, stop, deferred, peaks)

    @property
    def largest(self) -> float:
        if self.training:
            return 1.0
        if self._largest is None:  # it reads all leaves, which takes as long as a part of a picture
            self._largest = max(error_bound(self.colors.table.detach(), 1.0), 1.0)
        return self._largest

    def train(self: OctreeModelT, mode: bool = True) -> OctreeModelT:
        """Set training or evaluation mode. Leaves change in training alone, so pictures bound their errors once.

        Args:
            mode: True for training.
        """
        if mode:
            self._largest = None
        return super().train(mode)

    def loss(self, batch: PixelBatch, step: int) -> Loss:
        rendered = self.render(batch.rays, batch.background.repeat_interleave(batch.rays_per_pixel, 0))
        rgb = rendered.to_pixels(batch.rays_per_pixel).rgb
        terms = {"rgb": mean_squared_error(rgb, batch.rgb, batch.weights)}
        return Loss(terms, rgb.detach(), rendered.num_samples)

    @property
    def samples_per_step(self) -> int | None:
        """Number of leaves that the rays of a training step meet, as configured; None for a fixed number of rays."""
        return self.config.samples_per_batch

    @property
    def uses_bfloat16(self) -> bool:
        return False  # there is no network

    @property
    def runs_on_kernels(self) -> bool:
        """Return True, so that torch's own operations use one CPU thread."""
        return True
