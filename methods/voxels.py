"""Sparse voxels, learnt from photographs: from a coarse grid of fog to fine leaves on surfaces.

Fridovich-Keil et al., "Plenoxels: Radiance Fields without Neural Networks", CVPR 2022, and Sun et al., "Sparse Voxels
Rasterization: Real-time High-fidelity Radiance Field Rendering", CVPR 2025. There is no network: each leaf of an octree
has a density and harmonics of its colour. Training starts with few large leaves. Leaves that hardly show are dropped,
and the others are split.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from nerfloom import ConfigError, Dataset, Decision, Loss, Method, PixelBatch, Rays, RowChange, Scene
from nerfloom.base.config import AT_LEAST_0, AUTO, Auto, Range
from nerfloom.base.console import say
from nerfloom.base.decisions import Choice, fill
from nerfloom.base.device import HostValue, relative_speed
from nerfloom.base.processes import add_up
from nerfloom.kernels.adam.row_gradient import table_rows
from nerfloom.kernels.encodings.spherical_harmonics import CONSTANT
from nerfloom.kernels.octree.layout import OctreeLayout
from nerfloom.kernels.octree.light import depths_of, raw_of
from nerfloom.kernels.octree.weights import raise_weights
from nerfloom.losses.leaf_variation import leaf_variation
from nerfloom.octree_model import OctreeConfig, OctreeModel
from nerfloom.octrees.growth import UNMET, moments, split, visible
from nerfloom.octrees.hull import Hull

MAX_RESOLUTION = 2048
"""Maximum number of cells along an axis."""
CELLS_PER_PIXEL, MIN_CELLS, MAX_CELLS = 1.28, 64, 640
"""Default cells along the longest edge per pixel of the images' longer side, and their limits. If the object fills the
images, a cell is 0.8 pixels wide. The number of leaves grows with the square of the number of cells along an edge."""
CELLS_IN_A_MINUTE = 384
"""Default cells along the longest edge after a minute on two CPU threads. Four times the time allows twice as many, as
a leaf then takes part in the same number of steps."""
HULL_CELLS = 128
"""Cells along each axis of the grid that silhouettes carve."""
FOG = 1.0
"""Optical depth of the first leaves along the longest edge of their box."""
VARIED_BRICKS, STEPS_PER_VARIATION = 32, 4
"""Number of bricks with total variation in the loss, and number of steps from one such step to the next."""
COLOR_VARIATION = 0.1
"""Weight of the total variation of colours, relative to that of opacities."""
DENSITY_RATE = 16.0
"""Learning rate of densities, relative to the rate of colours."""
RAYS_PER_LOOK = 8
"""One training ray out of this number is followed to its end. It also meets leaves behind others, which are then known
to be hidden."""
UNUSED = ("depth_loss_mult", "free_space_loss_mult", "thin_gradients", "gradient_scaling")
"""Settings of other methods that cast rays, which have no meaning here."""


@dataclass(frozen=True)
class VoxelsConfig(
    OctreeConfig,
    max_num_iterations=20_000,
    learning_rate=0.025,
    lr_schedule="hold-exponential",
    lr_final=0.05,
    samples_per_batch=2**17,
):
    """Settings of voxels."""

    RANGES: ClassVar[dict[str, Range]] = {
        "resolution": (8, MAX_RESOLUTION),
        "num_splits": (0, 6),
        "max_leaves": (8, 2**26),
        "prune_weight": (0, 1),
        "total_variation": AT_LEAST_0,
    }
    GONE: ClassVar[dict[str, Any]] = {"silhouette_pixels": True, "density_rate": DENSITY_RATE}
    resolution: Auto[int] = AUTO
    """Cells along the longest edge of the box that silhouettes leave, at the end of training. auto: chosen from the
    images and the training time."""
    num_splits: int = 3
    """Number of times that leaves are split into eight. Training starts with --resolution / 2^num_splits cells."""
    max_leaves: int = 2**22
    """Maximum number of leaves. With more, the ones with the smallest weights on training rays are dropped."""
    prune_weight: float = 0.02
    """Leaves with a smaller weight on every training ray are dropped. This is the last threshold: earlier ones are
    smaller."""
    total_variation: float = 0.01
    """Weight of the total variation of opacities between neighbouring leaves; colours have a tenth."""
    silhouette_cells: bool = True
    """Place no leaf where an image's alpha channel shows empty space, and never draw pixels if their ray passes only
    through such space."""

    density_rate = DENSITY_RATE
    images_per_batch = 0  # large leaves are met by many rays of a step, which should be from many directions


def decide(config: VoxelsConfig, scene: Scene) -> tuple[VoxelsConfig, list[Decision]]:
    """Fill in the resolution."""
    cells = min(max(round(CELLS_PER_PIXEL * scene.image_size), MIN_CELLS), MAX_CELLS)
    reason = f"the images have {scene.image_size} pixels along a side"
    if config.max_seconds is not None:
        minutes = config.max_seconds * relative_speed(config.machine) / 60
        in_time = max(round(CELLS_IN_A_MINUTE * math.sqrt(minutes)), MIN_CELLS)
        cells, reason = (in_time, "that suits the time") if in_time < cells else (cells, reason)
    whole = first_cells(cells, config.num_splits) << config.num_splits
    return fill(config, Choice("resolution", whole, reason, "cells along the longest edge"))


def first_cells(cells: int, num_splits: int) -> int:
    """Return the number of cells along an edge before leaves are split.

    Args:
        cells: wanted number of cells after all splits.
        num_splits: number of splits; each doubles the number.
    """
    return max(cells >> num_splits, 1)


class Voxels(OctreeModel[VoxelsConfig]):
    """An octree with leaves that become smaller and fewer during training.

    Raises:
        ConfigError: if a setting has no meaning here, or there are too many leaves to begin with.
    """

    resizes = ends_at_box = True
    changes: Tensor
    """Number () int64 of changes of the leaves so far."""

    def __init__(self, config: VoxelsConfig, scene: Scene) -> None:
        super().__init__(config, scene)
        if scene.warped:
            raise ConfigError("voxels cannot learn normalised device coordinates: leave out --ndc, or take nerfacto")
        for name in UNUSED:
            if (value := getattr(config, name)) != getattr(METHOD.config, name):
                flag = name.replace("_", "-")
                raise ConfigError(f"--{flag} is {value}, and voxels learns from colours alone: leave it out")
        first = first_cells(config.resolution, config.num_splits)
        if first**3 > config.max_leaves:
            raise ConfigError(
                f"--resolution {config.resolution} starts with {first}^3 cells, and --max-leaves is "
                f"{config.max_leaves:,}: raise --num-splits"
            )
        self.hull = Hull(scene.box.cpu(), HULL_CELLS)
        self.register_buffer("changes", torch.zeros((), dtype=torch.int64))
        self.peaks = torch.zeros(0)
        self._moments, self._num_changes = moments(config.num_splits), HostValue()
        self._begin(first)

    def start(self, dataset: Dataset) -> None:
        """Set the first leaves: fog wherever `hull`, which silhouettes have carved, allows matter."""
        self._begin(first_cells(self.config.resolution, self.config.num_splits))

    @torch.no_grad()
    def _begin(self, cells: int) -> None:
        """Set grey fog in a grid with a number of `cells` along the longest edge."""
        layout = self.hull.leaves(cells)
        raw = raw_of(layout.origin.new_full((layout.num_leaves, 1), FOG / cells))
        coefficients = layout.origin.new_zeros(layout.num_leaves, 3, (self.config.degree + 1) ** 2)
        coefficients[..., 0] = 0.5 / CONSTANT
        self.set_octree(layout, raw, coefficients.flatten(1))

    def loss(self, batch: PixelBatch, step: int) -> Loss:
        """Return the error of colours and, in some steps, the total variation of some leaves."""
        loss = super().loss(batch, step)
        if self.training:
            self._look(batch.rays[::RAYS_PER_LOOK])
        if not self.config.total_variation or step % STEPS_PER_VARIATION:
            return loss
        return replace(loss, terms=loss.terms | {"variation": self.config.total_variation * self._variation()})

    def _look(self, rays: Rays) -> None:
        """Raise the largest weights of the leaves that some rays meet, also behind where training ends a ray."""
        assert self.peaks is not None
        raise_weights(self.layout, self.densities.table.detach(), rays, self.peaks)

    def _variation(self) -> Tensor:
        """Return the total variation () of the leaves of some bricks in a row."""
        firsts = self.layout.firsts[:, 0]
        begin = int(torch.randint(max(len(firsts) - VARIED_BRICKS, 0) + 1, ()))
        ends = [*firsts[begin : begin + VARIED_BRICKS + 1].tolist(), self.layout.num_leaves]
        rows = torch.arange(ends[0], ends[min(VARIED_BRICKS, len(ends) - 1)], device=self.device)
        cells = self.cells[rows].long()
        raw, colors = (table_rows(each.table, rows, each.deferred) for each in (self.densities, self.colors))
        opacities = -torch.expm1(-depths_of(raw))
        return leaf_variation(opacities, cells) + COLOR_VARIATION * leaf_variation(CONSTANT * colors, cells)

    def changes_rows(self, step: int, progress: float) -> bool:
        done = int(self._num_changes.of(self.changes))
        return done < len(self._moments) and progress >= self._moments[done][0]

    @torch.no_grad()
    def after_step(self, step: int, progress: float) -> Sequence[RowChange]:
        assert self.peaks is not None
        done, layout = int(self._num_changes.of(self.changes)), self.layout
        splits, most = self._moments[done][1], self.config.max_leaves
        self.changes += 1
        # Sums over processes are at least the maxima. Thresholds rise, as coarse fog has small weights everywhere.
        met, sums = add_up((self.peaks >= 0).float()) > 0, add_up(self.peaks.clamp(min=0))
        peaks, least = torch.where(met, sums, UNMET), self.config.prune_weight * (done + 1) / len(self._moments)
        kept = visible(peaks, least, most // 8 if splits else most)
        if (dropped := int((peaks >= least).sum()) - len(kept)) > 0:
            say(f"note: {dropped:,} visible leaves are dropped, since --max-leaves is {most:,}")
        cells, tables = self.cells[kept].long(), (self.densities.table, self.colors.table)
        if splits:
            finer, chosen = split(layout, cells)
        else:
            finer, chosen = OctreeLayout.build(layout.origin, layout.cell, layout.size, cells)
        rows = kept[chosen]
        self.set_layout(finer)
        # Leaves that no ray has met stay once: if none meets them before the next change either, no image shows them.
        self.peaks[peaks[rows] < 0] = 0
        if not splits:
            return [RowChange(table, rows) for table in tables]
        # An edge is half as long, so half as deep. Rows are new for Adam: gradients of smaller leaves are smaller.
        values = raw_of(self.depths(rows) / 2)[:, None], self.coefficients()[rows]
        return [RowChange(table, kept[:0], fresh) for table, fresh in zip(tables, values, strict=True)]


METHOD = Method(VoxelsConfig(), paper="arXiv:2112.05131", model=Voxels, decide=decide)
