"""Features in planes and lines by torch's `grid_sample`: what the compiled lookup is held against."""

from __future__ import annotations

from functools import reduce

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from framework.kernels.planes import PlanesLayout


def layouts() -> list[tuple[str, PlanesLayout, int]]:
    """Names, layouts and features of K-Planes, still and moving, and of TensoRF."""
    scales = tuple((64 << s,) * 3 for s in range(4))
    moving = tuple((64 << s,) * 3 + (25,) for s in range(4))
    across = (((0, 1), (2,)), ((0, 2), (1,)), ((1, 2), (0,)))
    return [
        ("K-Planes, 4 scales to 512, 3 planes of 32", PlanesLayout.build(scales), 32),
        ("K-Planes, 4 scales to 512, 6 planes of 32", PlanesLayout.build(moving), 32),
        ("TensoRF VM, 300^3, 48", PlanesLayout.build(((300,) * 3,) * 3, across), 48),
    ]


def planes_of(table: Tensor, layout: PlanesLayout) -> list[Tensor]:
    """Every factor as an image (1, F, H, W) of its own, as K-Planes' code has them; group by group."""
    return [
        layout.factor(table, group, index).permute(2, 0, 1)[None].contiguous()
        for group, factors in enumerate(layout.axes)
        for index in range(len(factors))
    ]


def grid_samples(positions: Tensor, images: list[Tensor], layout: PlanesLayout) -> Tensor:
    """Features (N, G * F) at positions (N, D) in [0, 1], from the images of `planes_of`."""
    left, groups = iter(images), []
    for factors in layout.axes:
        found = []
        for axes in factors:
            where = positions[:, list(axes)]
            if len(axes) == 1:
                where = torch.cat([where, torch.zeros(len(positions), 1)], dim=1)
            places = where[None, None] * 2 - 1
            image = grid_sample(next(left), places, align_corners=True, padding_mode="border")
            found.append(image[0, :, 0].t())
        groups.append(reduce(torch.mul, found))
    return torch.cat(groups, dim=-1)
