"""Coarser levels: their densities in closed form, and pictures from afar against supersampled ones."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras, subpixels
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.view import View
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.encodings.spherical_harmonics import CONSTANT
from nerfloom.kernels.octree.layout import OctreeLayout
from nerfloom.kernels.octree.packed import trace_packed
from nerfloom.octrees.coarser import halved, with_levels
from nerfloom.octrees.drawn import DrawnOctree
from nerfloom.octrees.octree import Octree
from nerfloom.octrees.packing import packed
from tests.octrees.balls import ball, boxes

CELL, BRICKS = 0.02, 16
BLACK = torch.zeros(3)


def octree_of(cells: Tensor, depths: Tensor, colors: Tensor, size: tuple[int, int, int] = (1, 1, 1)) -> Octree:
    """Leaves of some colours, in a box around the origin."""
    origin = -4 * CELL * torch.tensor(size)
    layout, rows = OctreeLayout.build(origin, CELL, size, cells)
    leaves, _ = packed(depths[rows], colors[rows] / CONSTANT)
    return Octree(layout, leaves, Placement.of(torch.eye(3, 4), 1.0), 0.1, 100.0, False, 400)


@pytest.mark.parametrize(
    ("cells", "depth", "expected"),
    [
        ([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], 0.7, 1.4),  # full
        ([[x, 1, z] for x in (0, 1) for z in (0, 1)], 40.0, 40.0),  # a sheet
        ([[0, 0, 0], [0, 0, 1], [1, 1, 0], [1, 1, 1]], 40.0, 40.0),  # a sheet that lies aslant
        ([[0, 1, 0], [0, 1, 1]], 40.0, math.log(2)),  # a post
        ([[1, 0, 1]], 40.0, math.log(4 / 3)),  # a grain
        ([[0, 0, 0], [1, 1, 1], [0, 1, 0]], 1e-3, 2 * 3e-3 / 8),  # thin matter
    ],
)
def test_the_depth_of_eight_cells(cells: list[list[int]], depth: float, expected: float) -> None:
    octree = octree_of(torch.tensor(cells) + 2, torch.full((len(cells),), depth), torch.ones(len(cells), 3))
    found = halved(octree)
    assert found.layout.cells().tolist() == [[1, 1, 1]]
    given = octree.leaves.depths()[0] / depth  # rounded to bytes
    assert float(found.leaves.depths()) == pytest.approx(expected * float(given), rel=0.02)


def test_the_color_of_eight_cells_is_the_mean_by_opacity() -> None:
    cells, depths = torch.tensor([[0, 0, 0], [1, 0, 0]]), torch.tensor([20.0, 0.5])
    found = halved(octree_of(cells, depths, torch.tensor([[1.0, 0, 0], [0, 1, 0]])))
    second = 1 - math.exp(-0.5)
    expected = torch.tensor([[1.0, second, 0]]) / (1 + second)
    torch.testing.assert_close(CONSTANT * found.leaves.coefficients(), expected, atol=0.01, rtol=0)


def test_levels_end_with_a_leaf_and_begin_with_the_given_ones() -> None:
    octree = ball()
    found = with_levels(octree)
    levels = found.layout.levels
    assert [level.size for level in levels] == [(4, 4, 4), (2, 2, 2), *[(1, 1, 1)] * 4]
    assert [level.cell / octree.layout.cell for level in levels] == [2.0**number for number in range(6)]
    assert levels[-1].own_leaves == 1
    leaves, count = found.leaves, octree.layout.num_leaves
    assert torch.equal(leaves.codes[:count], octree.leaves.codes)
    assert torch.equal(leaves.colors[:count], octree.leaves.colors)
    assert torch.equal(leaves.table[:256], octree.leaves.table)
    assert len(leaves.codes) == found.layout.num_leaves
    assert found.finest(1).layout.coarser is None
    assert torch.equal(found.finest(1).leaves.codes, octree.leaves.codes)
    middle = with_levels(octree).finest(2)
    assert [level.size for level in middle.layout.levels] == [(4, 4, 4), (2, 2, 2)]
    deepest = leaves.depths(found.layout.level_of(torch.arange(len(leaves.codes))))
    assert float(deepest[count:].max()) > 9  # cells of twice the edge, inside of the ball


def test_boxes_around_others_have_larger_leaves_inside_too() -> None:
    octree = boxes()
    given, found = octree.layout.levels, with_levels(octree)
    levels = found.layout.levels
    assert [level.size for level in levels[:4]] == [(4, 4, 4)] * 3 + [(2, 2, 2)]
    alone = with_levels(octree.finest(1))
    inside = alone.layout.levels[1]
    assert levels[1].own_leaves == given[1].own_leaves + inside.own_leaves
    rays = Rays(torch.tensor([[0.03, -60.0, 0.02]]), torch.tensor([[0.0, 1.0, 0.0]]))
    model, radius = DrawnOctree(octree, octree.scene), torch.tensor([0.004])
    far = model.light(replace(rays, pixel_radii=radius), BLACK, 0.0)
    assert float(far.opacity) > 0.9  # the ball, as a few large leaves
    near = model.light(replace(rays, pixel_radii=radius / 100), BLACK, 0.0)
    plain = trace_packed(octree.layout, octree.leaves, rays, BLACK)
    assert torch.equal(near.color, plain.color)
    assert not torch.equal(far.color, plain.color)


def chequered() -> Octree:
    """A wall of two layers of black and white cells; a pixel far away is grey."""
    cells = torch.cartesian_prod(torch.arange(8 * BRICKS), torch.arange(2), torch.arange(8 * BRICKS))
    white = (cells.sum(-1) % 2).float()
    return octree_of(cells, torch.full((len(cells),), 20.0), white[:, None].expand(-1, 3), (BRICKS, 1, BRICKS))


def posts() -> Octree:
    """White posts, one cell thick and seven cells apart."""
    cells = torch.cartesian_prod(torch.arange(3, 8 * BRICKS, 8), torch.arange(1), torch.arange(8 * BRICKS))
    return octree_of(cells, torch.full((len(cells),), 20.0), torch.ones(len(cells), 3), (BRICKS, 1, BRICKS))


def camera(distance: float) -> Cameras:
    """A camera that looks along y at the wall; a pixel is 0.02 wide at distance 1."""
    pose = torch.tensor([[[1.0, 0, 0, 0], [0, 0, -1, -distance], [0, 1, 0, 0]]])
    size, length, middle = torch.tensor([32]), torch.tensor([50.0]), torch.tensor([16.0])
    return Cameras(pose, length, length, middle, middle, size, size)


def traced(octree: Octree, seen_by: Cameras, per_pixel: int = 1) -> Tensor:
    rays = seen_by.pixel_rays(seen_by.image_pixels(0), 0.0, 100.0, None, subpixels(per_pixel))
    return trace_packed(octree.layout, octree.leaves, rays, BLACK).color.view(-1, per_pixel, 3).mean(1)


@pytest.mark.parametrize("make", [chequered, posts])
@pytest.mark.parametrize("distance", [7.3, 21.5])
def test_pictures_from_afar_are_closer_to_supersampled_ones(make, distance: float) -> None:
    """Rays of 16 positions in a pixel are traced through the finest level. A pixel is 7 or 21 cells wide."""
    octree, seen_by = make(), camera(distance)
    truth = traced(octree, seen_by, 16)
    model = DrawnOctree(octree, octree.scene)
    smooth = model.render_view(View(seen_by), BLACK).rgb.view(-1, 3)
    errors = [float((picture - truth).square().mean()) for picture in (traced(octree, seen_by), smooth)]
    print(f"squared error {errors[0]:.3g} without coarser levels, {errors[1]:.3g} with them")
    assert 0 < errors[1] < errors[0] / 3
    assert float(smooth.mean()) == pytest.approx(float(truth.mean()), rel=0.3)


def test_a_wall_does_not_fade_with_distance() -> None:
    octree = chequered()
    far = DrawnOctree(octree, octree.scene).render_view(View(camera(21.5)), BLACK)
    assert float(far.accumulation[14:18, 14:18].min()) > 0.999


def test_near_pictures_keep_their_bits_and_need_no_levels() -> None:
    octree, seen_by = chequered(), camera(2.0)
    model = DrawnOctree(octree, octree.scene)
    model.early_stop = 0.0
    picture = model.render_view(View(seen_by), BLACK)
    assert torch.equal(picture.rgb.view(-1, 3), traced(octree, seen_by).clamp(0, 1))
    assert "_with_levels" not in vars(model)
    model.render_view(View(camera(7.3)), BLACK)
    assert "_with_levels" in vars(model)
    sharp = model.render_view(View(camera(7.3), rays_per_pixel=16), BLACK).rgb.view(-1, 3)
    torch.testing.assert_close(sharp, traced(octree, camera(7.3), 16).clamp(0, 1))  # each ray has a quarter of 7 cells
