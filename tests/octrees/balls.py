"""Fully known octrees."""

from dataclasses import replace

import torch
from torch import Tensor

from nerfloom.cameras.poses import Placement
from nerfloom.kernels.encodings.spherical_harmonics import CONSTANT
from nerfloom.kernels.octree.layout import OctreeLayout
from nerfloom.octrees.octree import Octree
from nerfloom.octrees.packing import packed

RADIUS, CELL = 0.5, 0.05


def ball_cells(radius: float = RADIUS) -> Tensor:
    """Cells (N, 3) of a ball in a box of 4^3 bricks around the origin."""
    cells = torch.cartesian_prod(*[torch.arange(32)] * 3)
    return cells[((cells - 15.5).norm(dim=-1) * CELL) < radius]


def ball(degree: int = 1, depth: float = 5.0) -> Octree:
    """An opaque ball, red above its middle along z and blue below, from every side."""
    layout, rows = OctreeLayout.build(torch.full((3,), -16 * CELL), CELL, (4, 4, 4), ball_cells())
    above = layout.centers()[:, 2] > 0
    color = torch.where(above[:, None], torch.tensor([0.9, 0.1, 0.1]), torch.tensor([0.1, 0.1, 0.9])) / CONSTANT
    coefficients = torch.zeros(len(rows), 3, (degree + 1) ** 2)
    coefficients[..., 0] = color
    leaves, _ = packed(torch.full((len(rows),), depth), coefficients.view(len(rows), -1))
    placement = Placement.of(torch.eye(3, 4), 0.25)
    return Octree(layout, leaves, placement, 0.1, 10.0, True, 400)


def grains(degree: int, share: float = 0.4) -> Octree:
    """Cells of all densities and colours in a ball and in a corner far from it, with empty bricks around."""
    torch.manual_seed(degree)
    size, cell = (6, 4, 5), 0.04
    cells = torch.cartesian_prod(*(torch.arange(8 * bricks) for bricks in size))
    centers = cell * (cells + 0.5 - 4 * torch.tensor(size))
    inside = (centers.norm(dim=-1) < 0.5) & (torch.rand(len(cells)) < share)
    corner = (cells < 3).all(-1)
    origin = -4 * cell * torch.tensor(size)
    layout, rows = OctreeLayout.build(origin, cell, size, cells[inside | corner])
    coefficients = 0.15 * torch.randn(len(rows), 3, (degree + 1) ** 2)
    coefficients[..., 0] = 0.5 / CONSTANT + 0.8 * torch.randn(len(rows), 3)
    depths = torch.exp(torch.randn(len(rows)))
    placement = Placement.of(torch.eye(3, 4), 0.25)
    leaves, _ = packed(depths, coefficients.view(len(rows), -1))
    return Octree(layout, leaves, placement, 0.1, 10.0, True, 200)


def boxes(degree: int = 1) -> Octree:
    """The ball in the smallest of three boxes; grains of all densities and colours in the others."""
    torch.manual_seed(degree)
    inner = ball(degree)
    levels, cells = [inner.layout], torch.cartesian_prod(*[torch.arange(32)] * 3)
    around = cells[~((cells >= 8) & (cells < 24)).all(-1)]
    for _ in range(2):
        some = around[torch.rand(len(around)) < 0.05]
        levels.append(OctreeLayout.build(levels[-1].around(), 2 * levels[-1].cell, (4, 4, 4), some)[0])
    layout = levels[0].within(levels[1:])
    count = layout.num_leaves - inner.layout.num_leaves
    depths = torch.cat([inner.leaves.depths(), torch.exp(torch.randn(count))])
    colors = 0.3 * torch.randn(count, 3 * (degree + 1) ** 2)
    leaves, _ = packed(depths, torch.cat([inner.leaves.coefficients(), colors]))
    return replace(inner, layout=layout, leaves=replace(leaves, table=leaves.table.repeat(3)))
