"""Features of planes and lines by torch's `grid_sample`, for comparison with the compiled look-up."""

from __future__ import annotations

from functools import reduce

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from nerfloom.kernels.grids.planes_layout import PlanesLayout


def layouts() -> list[tuple[str, PlanesLayout, int]]:
    """Return names, layouts and features per group of K-Planes, static and moving, and of TensoRF."""
    scales = tuple((64 << s,) * 3 for s in range(4))
    moving = tuple((64 << s,) * 3 + (25,) for s in range(4))
    vm = (((0, 1), (2,)), ((0, 2), (1,)), ((1, 2), (0,)))
    return [
        ("K-Planes, 4 scales to 512, 3 planes of 32", PlanesLayout.build(scales), 32),
        ("K-Planes, 4 scales to 512, 6 planes of 32", PlanesLayout.build(moving), 32),
        ("TensoRF VM, 300^3, 48", PlanesLayout.build(((300,) * 3,) * 3, vm), 48),
    ]


def planes_of(table: Tensor, layout: PlanesLayout) -> list[Tensor]:
    """Return each factor of `layout` in `table` (E, F) as an image (1, F, H, W), as K-Planes' code has it, by group."""
    return [
        layout.factor(table, group, index).permute(2, 0, 1)[None].contiguous()
        for group, factors in enumerate(layout.axes)
        for index in range(len(factors))
    ]


def grid_samples(positions: Tensor, images: list[Tensor], layout: PlanesLayout) -> Tensor:
    """Return products (N, G * F) of the factors, `images` of `layout`, of each of G groups at `positions` (N, D)."""
    remaining, groups = iter(images), []
    for factors in layout.axes:
        values = []
        for axes in factors:
            coordinates = positions[:, list(axes)]
            if len(axes) == 1:
                coordinates = torch.cat([coordinates, torch.zeros(len(positions), 1)], dim=1)
            grid = coordinates[None, None] * 2 - 1
            image = grid_sample(next(remaining), grid, align_corners=True, padding_mode="border")
            values.append(image[0, :, 0].t())
        groups.append(reduce(torch.mul, values))
    return torch.cat(groups, dim=-1)
