"""Octrees of several levels: against short steps in float64, which choose their level by the rule, and compiled."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfloom.geometry.rays import Rays
from nerfloom.kernels.encodings.spherical_harmonics import CONSTANT
from nerfloom.kernels.octree.layout import BRICK, OctreeLayout
from nerfloom.kernels.octree.light import light_of
from nerfloom.kernels.octree.packed import CODES, PackedLeaves, trace_packed, trace_packed_reference
from nerfloom.kernels.octree.trace import trace_octree
from nerfloom.kernels.octree.walk import CELLS_PER_PIXEL, leaf_at, smallest_cells
from nerfloom.kernels.octree.weights import raise_weights, raise_weights_reference
from tests.kernels.compiled import needs_kernels, relative_error
from tests.kernels.test_octree import in_float64, same

CELL, STEPS, END = 0.08, 60_000, 16.0


def nested(share: float = 0.2, levels: int = 3) -> OctreeLayout:
    """Grids of 16^3 cells around the origin, each with twice the edge of the one before, full of scattered leaves."""
    cells = torch.cartesian_prod(*[torch.arange(2 * BRICK)] * 3)
    found = []
    for level in range(levels):
        origin = torch.full((3,), -BRICK * CELL * 2.0**level)
        some = cells[torch.rand(len(cells)) < share]
        found.append(OctreeLayout.build(origin, CELL * 2**level, (2, 2, 2), some)[0])
    return found[0].within(found[1:])


def rays_through(count: int) -> Rays:
    """Rays through the middle, from inside and outside of all boxes; two thirds of the pixels are wide."""
    targets = torch.rand(count, 3) - 0.5
    origins = targets + torch.randn(count, 3) * torch.rand(count, 1) * 3
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    radii = torch.where(torch.rand(count) < 2 / 3, 0.1 * torch.rand(count), 0.0)
    return Rays(origins, directions, torch.zeros(count), torch.full((count,), END), radii)


def by_short_steps(layout: OctreeLayout, depths: Tensor, colors: Tensor, rays: Rays, smallest: Tensor) -> Tensor:
    """Colour (R, 3) and opacity of rays over black."""
    tables = []
    for level, first in zip(layout.levels, layout.firsts_of_levels, strict=False):
        table = torch.full([BRICK * count for count in level.size], -1)
        table[tuple(level.cells().T)] = first + torch.arange(level.own_leaves)
        tables.append(table)
    edges, out = layout.edges_of(torch.arange(len(depths)), torch.float64), []
    t = (torch.arange(STEPS, dtype=torch.float64) + 0.5) * (END / STEPS)
    for origin, direction, least in zip(
        rays.origins.double(), rays.directions.double(), smallest.double(), strict=True
    ):
        leaf, open_ = torch.full((STEPS,), -1), torch.ones(STEPS, dtype=torch.bool)
        for number, (level, table) in enumerate(zip(layout.levels, tables, strict=True)):
            cell = ((origin + t[:, None] * direction - level.origin.double()) / level.cell).floor().long()
            inside = ((cell >= 0) & (cell < torch.tensor(table.shape))).all(-1) & open_
            if number < len(tables) - 1:
                inside &= least * t <= level.cell
            leaf[inside] = table[tuple(cell[inside].T)]
            open_ &= ~inside
        tau = torch.where(leaf < 0, 0.0, depths[leaf] / edges[leaf] * (END / STEPS))
        through = torch.exp(-(tau.cumsum(0) - tau))
        weight = through * -torch.expm1(-tau)
        out.append(torch.cat([(weight[:, None] * colors[leaf]).sum(0), weight.sum()[None]]))
    return torch.stack(out)


@pytest.mark.medium
def test_each_point_of_a_ray_is_shown_by_the_level_of_the_rule() -> None:
    torch.manual_seed(0)
    layout, rays = nested(), rays_through(24)
    count = layout.num_leaves
    depths, colors = torch.rand(count, dtype=torch.float64), torch.rand(count, 3, dtype=torch.float64)
    smallest = smallest_cells(rays)
    assert smallest is not None
    exact = in_float64(rays)
    found = light_of(
        layout, depths, colors / CONSTANT, exact, torch.zeros(24, 3).double(), 0.0, smallest=smallest.double()
    )
    truth = by_short_steps(layout, depths, colors, rays, smallest)
    error = (torch.cat([found.color, found.opacity[:, None]], 1) - truth).abs().max()
    print(f"error {error:.2g}")
    assert error < 0.01
    plain = light_of(layout.within([]), depths, colors / CONSTANT, exact, torch.zeros(24, 3).double(), 0.0)
    assert float((plain.color - found.color).abs().max()) > 0.1


def test_the_width_of_a_pixel_is_measured_in_cells() -> None:
    """A pixel with the radius of a disk of its variance; at this distance it is as wide as CELLS_PER_PIXEL cells."""
    width = 0.02
    rays = Rays(torch.zeros(1, 3), torch.eye(3)[:1], pixel_radii=torch.tensor([2 / 12**0.5 * width]))
    (smallest,) = smallest_cells(rays)
    distance = CELLS_PER_PIXEL * CELL / width
    assert float(smallest) * distance == pytest.approx(CELL)


@needs_kernels
@pytest.mark.parametrize("levels", [1, 2, 3])
def test_compiled_levels_are_the_references(levels: int) -> None:
    torch.manual_seed(levels)
    layout, rays, background = nested(levels=levels), rays_through(3000), torch.rand(3000, 3)
    count = layout.num_leaves
    codes, colors = (torch.randint(CODES, shape, dtype=torch.uint8) for shape in ((count,), (count, 12)))
    tables = torch.cat([torch.linspace(0, 1 + level, CODES) for level in range(levels)])
    leaves = PackedLeaves(codes, tables, colors, torch.rand(12) / 255, torch.rand(12) - 0.5)
    for some in (rays, replace(rays, pixel_radii=None)):
        found = trace_packed(layout, leaves, some, background)
        same(found, trace_packed_reference(layout, leaves, some, background), 5e-4, medians=0.01)


@needs_kernels
def test_levels_have_gradients_and_weights() -> None:
    torch.manual_seed(3)
    layout, rays, background = nested(), rays_through(1000), torch.rand(1000, 3)
    count, found = layout.num_leaves, []
    for kind in (torch.float32, torch.float64):
        torch.manual_seed(4)
        raw, coefficients = (torch.randn(count, width, dtype=torch.float64).to(kind) for width in (1, 12))
        for values in (raw, coefficients):
            values.requires_grad_()
        cast = rays if kind == torch.float32 else in_float64(rays)
        light = trace_octree(layout, raw, coefficients, cast, background.to(kind))
        (light.color.square().sum() + light.opacity.sum()).backward()
        found.append((light.color.detach(), raw.grad, coefficients.grad))
    for value, truth in zip(*found, strict=True):
        assert relative_error(value, truth) < 5e-4
    assert all(part.any() for part in found[0][1].split([level.own_leaves for level in layout.levels]))
    weights = torch.zeros(2, count)
    raise_weights(layout, raw.detach().float(), rays, weights[0])
    raise_weights_reference(layout, raw.detach().float(), rays, weights[1])
    assert float((weights[0] - weights[1]).abs().max()) < 1e-4


@needs_kernels
def test_wide_pixels_alone_see_coarser_leaves_in_the_same_box() -> None:
    """Rays as narrow as in the finest level keep their bits; a box that is no multiple of two bricks is padded."""
    torch.manual_seed(5)
    cells = torch.cartesian_prod(*[torch.arange(BRICK * count) for count in (3, 2, 1)])
    origin = torch.tensor([-1.0, -0.7, -0.3])
    fine, _ = OctreeLayout.build(origin, CELL, (3, 2, 1), cells[torch.rand(len(cells)) < 0.3])
    halves = torch.unique(fine.cells() // 2, dim=0)
    coarse, _ = OctreeLayout.build(origin, 2 * CELL, (2, 1, 1), halves)
    layout = fine.within([coarse])
    count, rays = layout.num_leaves, rays_through(500)
    codes, colors = (torch.randint(CODES, shape, dtype=torch.uint8) for shape in ((count,), (count, 3)))
    leaves = PackedLeaves(codes, torch.linspace(0, 3, CODES).repeat(2), colors, torch.ones(3) / 255, torch.zeros(3))
    first = replace(
        leaves, codes=codes[: fine.own_leaves], colors=colors[: fine.own_leaves], table=leaves.table[:CODES]
    )
    plain = trace_packed(fine, first, rays, torch.ones(3))
    narrow = trace_packed(layout, leaves, replace(rays, pixel_radii=torch.zeros(500)), torch.ones(3))
    assert torch.equal(plain.color, narrow.color)
    assert torch.equal(plain.opacity, narrow.opacity)
    wide = trace_packed(layout, leaves, replace(rays, pixel_radii=torch.full((500,), 1e3)), torch.ones(3))
    second = replace(leaves, codes=codes[fine.own_leaves :], colors=colors[fine.own_leaves :], table=first.table)
    alone = trace_packed(coarse, second, rays, torch.ones(3))
    met = rays.origins.norm(dim=-1) > 2  # others start in the box, where a pixel of any radius is narrow
    assert int(met.sum()) > 50
    torch.testing.assert_close(wide.color[met], alone.color[met], atol=1e-5, rtol=0)


def test_a_position_is_in_the_finest_box_that_contains_it() -> None:
    torch.manual_seed(6)
    layout = nested()
    centers = [level.centers()[: level.own_leaves] for level in layout.levels]
    found = leaf_at(layout, torch.cat(centers))
    expected = torch.arange(layout.num_leaves)
    outside = [(center.abs() > BRICK * CELL * 2.0 ** (number - 1)).any(-1) for number, center in enumerate(centers)]
    outside[0][:] = True
    seen = torch.cat(outside)
    assert torch.equal(found[seen], expected[seen])
    assert bool((found[~seen] != expected[~seen]).all())
    assert layout.level_of(expected).bincount().tolist() == [level.own_leaves for level in layout.levels]
    assert leaf_at(layout, torch.tensor([[9.0, 0, 0], [torch.nan, 0, 0]])).tolist() == [-1, -1]
