"""Marching: the same samples as the reference's in float64, wave by wave."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfloom.geometry.rays import Rays
from nerfloom.kernels.march.occupancy import Occupancy, own_cells
from nerfloom.kernels.march.ray_order import sort_by_ray, sort_by_ray_reference
from nerfloom.kernels.march.waves import ReferenceMarch, march
from tests.kernels.test_march import BOX, occupancy, random_rays, walk
from tests.kernels.triton.compared import DEVICE, backends


def on_device(rays: Rays, grid: Occupancy) -> tuple[Rays, Occupancy]:
    return rays.to(DEVICE), replace(grid, occupied=grid.occupied.to(DEVICE), box=grid.box.to(DEVICE))


def in_float64(rays: Rays, grid: Occupancy) -> tuple[Rays, Occupancy]:
    return rays.map(Tensor.double), replace(grid, box=grid.box.double())


@pytest.mark.parametrize(
    ("resolution", "share", "cone"),
    [(5, 0.3, 0.0), (33, 0.2, 1 / 64), pytest.param(8, 1.0, 1 / 64, marks=pytest.mark.slow), (8, 0.0, 0.0)],
)
def test_samples(resolution: int, share: float, cone: float) -> None:
    """Rounding decides about steps with the middle on a cell's face: one in a hundred, and one."""
    rays, grid = random_rays(33), occupancy(resolution, share)
    shift = torch.rand(33, generator=torch.Generator().manual_seed(1))
    with backends() as names:
        started = march(*on_device(rays, grid), 0.2, cone, shift.to(DEVICE), 0.0)
    assert names == ["triton"]
    found = []
    for each in (started, ReferenceMarch(*in_float64(rays, grid), 0.2, cone, shift.double(), 0.0)):
        starts, ends, owners, offsets = (part.cpu() for part in walk(each, limit=40))
        assert bool((ends > starts).all())
        assert offsets[-1] == len(starts)
        assert torch.equal(owners, torch.repeat_interleave(offsets.diff()))
        found.append(set(zip(owners.tolist(), ((starts + ends) / 2 / 1e-2).round().tolist(), strict=True)))
    near = [{(r, t + d) for r, t in samples for d in (-1, 0, 1)} for samples in found]
    assert len(found[0] - near[1]) + len(found[1] - near[0]) <= 1e-2 * len(found[1]) + 1
    assert (len(found[1]) > 5) == (share > 0)


def test_each_ray_marches_through_the_slice_of_its_time() -> None:
    """The even slices are full and the odd ones empty."""
    rays, full = random_rays(33), occupancy(5, 1.0)
    times = torch.rand(33, generator=torch.Generator().manual_seed(2))
    parts = [full.occupied, ~full.occupied] * 2
    grid = replace(full, occupied=torch.cat(parts), slices=4)
    _, _, _, found = walk(march(*on_device(replace(rays, times=times), grid), 0.2, 0.0, None, 0.0), limit=40)
    _, _, _, alone = walk(march(*on_device(rays, full), 0.2, 0.0, None, 0.0), limit=40)
    truth = torch.where((times * 4).long() % 2 == 0, alone.cpu().diff(), 0)
    assert torch.equal(found.cpu().diff(), truth)
    assert int(truth.sum()) > 50


@pytest.mark.parametrize(
    ("share", "cone"), [(0.02, 1 / 16), (0.3, 1 / 16), pytest.param(0.3, 0.0, marks=pytest.mark.slow)]
)
def test_samples_in_nested_boxes(share: float, cone: float) -> None:
    """Three boxes; rays start inside and outside the largest."""
    rays, single = random_rays(33), occupancy(8, share)
    larger = [occupancy(8, share, seed).occupied for seed in (1, 2)]
    grid = replace(single, occupied=torch.cat([single.occupied, *larger]) & own_cells(3, 8), levels=3)
    rays = replace(rays, origins=rays.origins * torch.linspace(0.1, 3, 33)[:, None])
    with backends() as names:
        started = march(*on_device(rays, grid), 0.2, cone, None, 0.0)
    assert names == ["triton"]
    found = []
    for each in (started, ReferenceMarch(*in_float64(rays, grid), 0.2, cone, None, 0.0)):
        starts, ends, owners, _ = (part.cpu() for part in walk(each, limit=40))
        found.append(set(zip(owners.tolist(), ((starts + ends) / 2 / 1e-2).round().tolist(), strict=True)))
    near = [{(r, t + d) for r, t in samples for d in (-1, 0, 1)} for samples in found]
    assert len(found[0] - near[1]) + len(found[1] - near[0]) <= 1e-2 * len(found[1]) + 1
    assert len(found[1]) > 10


@pytest.mark.parametrize("sigma", [0.0, 3.0, math.nan, math.inf])
def test_light_ends_rays_at_the_same_sample(sigma: float) -> None:
    """Everything is occupied, so that a sample's place does not depend on rounding."""
    rays, grid = random_rays(20), occupancy(4, 1.0)
    found = []
    for each in (march(*on_device(rays, grid), 0.2, 0.0, None, 0.01), ReferenceMarch(*in_float64(rays, grid), 0.2, 0.0,
                 None, 0.01)):  # fmt: skip
        *_, offsets = walk(each, limit=8, sigma=sigma)
        found.append(offsets.cpu().diff())
    assert (found[0] - found[1]).abs().max() <= 1  # the last step may end at the box's face
    assert (found[0] != found[1]).sum() <= 2
    assert bool((found[0] <= 1).all()) == (sigma >= 1e4)


def test_rays_that_miss_and_no_rays() -> None:
    away = Rays(torch.full((3, 3), 9.0), torch.eye(3))
    for rays in (away, away[:0]):
        marched = march(*on_device(rays, occupancy(4, 1.0)), 0.1, 0.0, None, 0.0)
        assert marched.wave(4) is None
        order, offsets = marched.finish()
        assert len(order) == 0
        assert offsets.tolist() == [0] * (len(rays) + 1)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.2])
def test_distances_of_blocks(share: float) -> None:
    """They equal the CPU kernel's, up to the largest distance that is told apart."""
    grid = occupancy(70, 0.0)
    grid.occupied[: int(share * 70**3)] = torch.rand(int(share * 70**3)) > 0.99
    side = -(-70 // 4)
    padded = torch.zeros(4 * side, 4 * side, 4 * side, dtype=torch.bool)
    padded[:70, :70, :70] = grid.occupied.view(70, 70, 70)
    full = padded.view(side, 4, side, 4, side, 4).amax((1, 3, 5)).nonzero()
    blocks = torch.stack(torch.meshgrid(*[torch.arange(side)] * 3, indexing="ij"), -1).view(-1, 1, 3)
    truth = (blocks - full).abs().amax(-1).amin(-1).clamp(max=16) if len(full) else torch.full((side**3,), 16)
    found = replace(grid, occupied=grid.occupied.to(DEVICE), box=BOX.to(DEVICE)).distances
    assert torch.equal(found.cpu().long(), truth.long())


@pytest.mark.parametrize(("count", "rays"), [(0, 3), (0, 0), (50, 7)])
def test_sorting_by_ray(count: int, rays: int) -> None:
    torch.manual_seed(0)
    owners, reached = torch.randint(max(rays, 1), (count,)), torch.randint(2, (count,), dtype=torch.uint8)
    with backends() as names:
        found = sort_by_ray(owners.to(DEVICE), reached.to(DEVICE), rays)
    assert names == ["triton"]
    for value, truth in zip(found, sort_by_ray_reference(owners, reached, rays), strict=True):
        assert torch.equal(value.cpu(), truth)
