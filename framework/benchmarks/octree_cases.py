"""Inputs of the operations of octrees, for `kernel_cases.py`: rays through a grid of leaves and a coarser one around.

Random leaves are thin: float32 knows lengths in cells to some 2e-6, and errors of weights are depths times this.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

from nerfloom.geometry.rays import Rays
from nerfloom.kernels.octree.layout import BRICK, OctreeLayout
from nerfloom.kernels.octree.packed import CODES, PackedLeaves, trace_packed
from nerfloom.kernels.octree.trace import trace_octree
from nerfloom.kernels.octree.weights import raise_weights

Inputs = dict[str, Tensor]
Family = tuple[str, Callable[..., Sequence[Tensor]], str, tuple[Inputs, Inputs, Inputs]]


def _octree(like: Tensor) -> OctreeLayout:
    """Return a grid of leaves around the origin, with a coarser one around it."""
    cells, sizes = torch.cartesian_prod(*[torch.arange(2 * BRICK)] * 3), (2, 2, 2)
    inner, _ = OctreeLayout.build(torch.full((3,), -4.0), 0.5, sizes, cells[cells.sum(-1) % 3 == 0])
    outer, _ = OctreeLayout.build(inner.around(), 1.0, sizes, cells[cells.sum(-1) % 7 == 0])
    return inner.within([outer]).to(like.device)


def in_octrees() -> Iterator[Family]:
    """Yield each operation, its name, its differentiable inputs, and its random, extreme and empty inputs."""
    count = _octree(torch.zeros(0)).num_leaves

    def rays(origins: Tensor, directions: Tensor) -> Rays:
        return Rays(origins, directions, pixel_radii=torch.full_like(origins[:, 0], 0.1))

    def traced(raw: Tensor, colors: Tensor, origins: Tensor, directions: Tensor) -> Sequence[Tensor]:
        light = trace_octree(_octree(raw), raw, colors, rays(origins, directions), torch.ones_like(origins))
        return light.color, light.opacity, light.moment

    def packed(codes: Tensor, bytes_: Tensor, origins: Tensor, directions: Tensor) -> Sequence[Tensor]:
        table = torch.linspace(0, 0.2, 2 * CODES, device=codes.device)
        scales = torch.linspace(0.2, 1, 12, device=codes.device) / 255
        leaves = PackedLeaves(codes.to(torch.uint8), table, bytes_.to(torch.uint8), scales, scales - 0.003)
        light = trace_packed(_octree(codes), leaves, rays(origins, directions), torch.ones_like(origins))
        return light.color, light.opacity, light.moment

    def weighted(raw: Tensor, origins: Tensor, directions: Tensor) -> Sequence[Tensor]:
        weights = torch.zeros_like(raw[:, 0])
        return raise_weights(_octree(raw), raw, rays(origins, directions), weights), weights

    origins = torch.nn.functional.normalize(torch.randn(33, 3), dim=-1) * 6
    towards = torch.nn.functional.normalize(3 * torch.rand(33, 3) - 1.5 - origins, dim=-1)
    axes = torch.cat([torch.eye(3), -torch.eye(3)])
    # Through the middle of cells, from outside, from inside, and past the octree.
    straight = torch.cat([-16 * axes + 0.25, axes / 4 + 0.125, 32 + axes * 64])
    places = [(origins, towards), (straight, axes.repeat(3, 1)), (origins[:0], towards[:0])]
    usual, colors = torch.randn(count, 1) - 3, torch.randn(count, 12)
    hard = torch.tensor([1e4, -1e4, 80.0, -80.0, 0.5, 1.5]).repeat(count)[:count, None]
    given = [{"origins": one, "directions": two} for one, two in places]
    raws = [{"raw": raw} for raw in (usual, hard, usual)]
    learnt = [{**raw, "colors": colors, **where} for raw, where in zip(raws, given, strict=True)]
    yield "trace_octree", traced, "raw colors", (learnt[0], learnt[1], learnt[2])
    codes = {"codes": torch.randint(CODES, (count,)).float(), "bytes_": torch.randint(256, (count, 12)).float()}
    yield "trace_packed", packed, "", ({**codes, **given[0]}, {**codes, **given[1]}, {**codes, **given[2]})
    weights = [{**raw, **where} for raw, where in zip(raws, given, strict=True)]
    yield "raise_weights", weighted, "", (weights[0], weights[1], weights[2])
