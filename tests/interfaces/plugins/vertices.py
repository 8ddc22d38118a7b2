"""Instant-NGP with a plain grid of voxels for its field: density and colour at each vertex, in torch alone."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample, softplus

from nerfloom import Field, Points, Scene, TrainConfig
from nerfloom.geometry.bounds import to_unit_box
from nerfloom.methods import instant_ngp

VERTICES = 48


class VoxelField(Field):
    """Density and colour, trilinear between the vertices of a grid over a box.

    Args:
        box: (2, 3) corners.
    """

    box: Tensor

    def __init__(self, box: Tensor) -> None:
        super().__init__()
        self.register_buffer("box", box.clone())
        self.grid = nn.Parameter(torch.zeros(1, 4, VERTICES, VERTICES, VERTICES))

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        unit = to_unit_box(points.positions, self.box)
        values = grid_sample(self.grid, 2 * unit.view(1, -1, 1, 1, 3) - 1, align_corners=True).view(4, -1).t()
        inside = ((unit >= 0) & (unit <= 1)).all(-1)
        return softplus(10 * values[:, 0].float()) * inside, values[:, 1:]

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return torch.sigmoid(10 * features).float()


def make_field(config: TrainConfig, scene: Scene) -> VoxelField:
    """Return an empty grid over the scene's box."""
    return VoxelField(scene.box)


METHOD = replace(instant_ngp.METHOD, field=make_field)
