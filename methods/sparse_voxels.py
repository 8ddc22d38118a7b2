"""Sparse voxels: density and harmonics in the cells of a grid, without a network, as in Plenoxels.

Fridovich-Keil et al., "Plenoxels: Radiance Fields without Neural Networks", CVPR 2022. The grid starts coarse, over the
box of what silhouettes allow; cells that no ray sees are dropped, and the others split, as the budget is spent.
Different from the paper: density and colour are constant in a cell, so integrals are exact and pictures are those of
`kernels/octree`, and there is no total variation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from nerfloom import Dataset, Decision, Method, Scene
from nerfloom.base.config import Range
from nerfloom.base.optimised import RowChange
from nerfloom.data.pixels.batch import PixelBatch
from nerfloom.kernels.encodings.spherical_harmonics import CONSTANT
from nerfloom.kernels.octree.layout import BRICK, OctreeLayout
from nerfloom.kernels.octree.weights import raise_weights
from nerfloom.model import Loss
from nerfloom.octree_model import STOP, OctreeConfig, OctreeModel
from nerfloom.octrees.grid import Grid
from nerfloom.octrees.packing import raw_of
from nerfloom.scene.silhouettes import Silhouettes, visual_hull

HULL = 128
"""Cells along an edge of the box for finding what silhouettes allow."""
FIRST_DEPTH, MARGIN_DEPTH = 0.05, 0.01
"""Optical depth of a cell's edge at the start, and of cells that are added around others."""
MIN_WEIGHT = 0.01
"""Minimum of a cell's largest weight on training rays."""
WATCHED = 0.04
"""Share of the budget before a split in which weights are watched."""


@dataclass(frozen=True)
class SparseVoxelsConfig(
    OctreeConfig, max_num_iterations=10_000, learning_rate=0.05, lr_schedule="hold-exponential", lr_final=0.05
):
    """Settings of sparse-voxels."""

    RANGES: ClassVar[dict[str, Range]] = {"first_resolution": (8, 1024), "splits_at": (0, 1)}
    """Allowed ranges."""
    first_resolution: int = 64
    """Cells along the longest edge of the box at the start."""
    splits_at: tuple[float, ...] = (0.06, 0.16, 0.4)
    """Shares of the budget after which cells are split into 8."""


class SparseVoxels(OctreeModel):
    """Sparse voxels that are dropped and split.

    Args:
        config: the settings.
        scene: the scene.
    """

    resizes: ClassVar[bool] = True

    def __init__(self, config: SparseVoxelsConfig, scene: Scene) -> None:
        super().__init__(config, scene)
        self.splits_at = config.splits_at
        self.splits, self._watching = 0, False
        self.weights = torch.zeros(0)
        box = scene.box.double().cpu()
        self._fill(Grid.of(box[0], box[1], config.first_resolution), None)

    def _fill(self, grid: Grid, hull: Tensor | None) -> None:
        """Start with all cells of a grid that the hull (HULL, HULL, HULL), of the scene's box, allows; None for all."""
        cells = torch.cartesian_prod(*[torch.arange(BRICK * count) for count in grid.size])
        box = self.scene.box.double().cpu()
        inside = grid.positions(cells + 0.5).double()
        cells = cells[((inside > box[0]) & (inside < box[1])).all(-1)]
        if hull is not None:
            kept = torch.zeros(len(cells), dtype=torch.bool)
            for corner in torch.cartesian_prod(*[torch.tensor([0.0, 0.5, 1.0])] * 3):
                unit = (grid.positions(cells + corner).double() - box[0]) / (box[1] - box[0])
                x, y, z = (unit * HULL).long().clamp(0, HULL - 1).unbind(-1)
                kept |= hull[x, y, z]
            cells = cells[kept]
        layout, _ = OctreeLayout.build(grid.origin, grid.cell, grid.size, cells)
        count, width = layout.num_leaves, self.colors.table.shape[1]
        colors = torch.zeros(count, 3, width // 3)
        colors[..., 0] = 0.5 / CONSTANT
        self.set_octree(layout, raw_of(torch.full((count, 1), FIRST_DEPTH)), colors.view(count, width))

    def set_octree(self, layout: OctreeLayout, raw: Tensor, coefficients: Tensor) -> None:
        super().set_octree(layout, raw, coefficients)
        self.weights = torch.zeros(layout.num_leaves)

    def start(self, dataset: Dataset) -> None:
        """Start in the box of what silhouettes allow, if there are any.

        Args:
            dataset: training images, on the model's device.
        """
        if not self.scene.has_alpha or dataset.cameras.model != "pinhole" or self.scene.moving:
            return
        box = self.scene.box.double().cpu()
        hull = visual_hull(Silhouettes.of(dataset), self.scene.box.cpu(), HULL).view(HULL, HULL, HULL)
        if not bool(hull.any()):
            return
        found = hull.nonzero()
        low, high = (box[0] + (box[1] - box[0]) * end / HULL for end in (found.amin(0), found.amax(0) + 1))
        self._fill(Grid.of(low, high, self.config.first_resolution), hull)

    def get_extra_state(self) -> dict[str, Any]:
        return {**super().get_extra_state(), "splits": self.splits, "weights": self.weights}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        super().set_extra_state(state)
        self.splits, self.weights = int(state["splits"]), state["weights"].float()

    def before_step(self, step: int, progress: float) -> None:
        """Watch weights before the next split, or before the end of the budget's first split.

        Args:
            step: number of training steps done.
            progress: fraction of the training budget that is spent.
        """
        self._watching = self.splits < len(self.splits_at) and progress > self.splits_at[self.splits] - WATCHED

    def loss(self, batch: PixelBatch, step: int) -> Loss:
        found = super().loss(batch, step)
        if self._watching:
            raise_weights(self.layout, self.densities.table.detach(), batch.rays, self.weights, STOP)
        return found

    def changes_rows(self, step: int, progress: float) -> bool:
        return self.splits < len(self.splits_at) and progress >= self.splits_at[self.splits]

    def after_step(self, step: int, progress: float) -> Sequence[RowChange]:
        """Drop cells that no ray has seen, add those around the others, and split all.

        Args:
            step: number of training steps done before this one.
            progress: fraction of the training budget that is spent.
        """
        layout, kept = self.layout, self.weights > MIN_WEIGHT
        cells, depths = layout.cells(), self.depths()
        colors = self.colors.table.detach()
        around = torch.cat([torch.eye(3, dtype=torch.int64), -torch.eye(3, dtype=torch.int64)])
        neighbours = (cells[kept][:, None] + around).view(-1, 3)
        top = BRICK * torch.tensor(layout.size)
        inside = ((neighbours >= 0) & (neighbours < top)).all(-1)
        all_cells = torch.cat([cells[kept], neighbours[inside]])
        origins = torch.cat([torch.arange(int(kept.sum())), torch.arange(len(around) * int(kept.sum())) // len(around)])
        grown, rows = OctreeLayout.build(layout.origin, layout.cell, layout.size, all_cells)
        sources = torch.cat([origins[: int(kept.sum())], origins[int(kept.sum()) :][inside]])[rows]
        new = rows >= int(kept.sum())
        depth = torch.where(new, MARGIN_DEPTH, depths[kept][sources])
        color = colors[kept][sources]
        corners = torch.cartesian_prod(*[torch.arange(2)] * 3)
        children = (2 * grown.cells()[:, None] + corners).reshape(-1, 3)
        size = [2 * count for count in layout.size]
        split, order = OctreeLayout.build(layout.origin, layout.cell / 2, size, children)
        parents = order // len(corners)
        self.layout, self.splits = split, self.splits + 1
        self.weights = torch.zeros(split.num_leaves)
        none = torch.zeros(0, dtype=torch.int64)
        return (
            RowChange(self.densities.table, none, raw_of(depth[parents] / 2)[:, None]),
            RowChange(self.colors.table, none, color[parents]),
        )


def decide(config: SparseVoxelsConfig, scene: Scene) -> tuple[SparseVoxelsConfig, list[Decision]]:
    """Say what an octree of a box cannot show."""
    if scene.unbounded:
        return config, [Decision("space outside the box", "not learnt", "voxels end with the box; nerfacto has no end")]
    return config, []


METHOD = Method(SparseVoxelsConfig(), paper="arXiv:2112.05131", model=SparseVoxels, decide=decide)
