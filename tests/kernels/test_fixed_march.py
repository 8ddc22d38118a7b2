"""Marching into a fixed number of slots: the candidates of the march, whole rays, and nothing that counts besides."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.compositing.density import composite
from nerfloom.kernels.march.fixed_slots import Placed, fill, fill_reference, longest_ray, most_steps, reach, share_out
from nerfloom.kernels.march.occupancy import Occupancy
from nerfloom.kernels.march.waves import candidates
from tests.kernels.test_march import BOX, occupancy, random_rays

STEPS = 40
SIZE = float((BOX[1] - BOX[0]).norm()) / STEPS
ROOMY = (4096, 8192)


@settings(max_examples=60)
@given(st.lists(st.integers(0, 9), min_size=1, max_size=12), st.integers(1, 60))
def test_slots_are_shared_out(counts: list[int], capacity: int) -> None:
    slots = share_out(torch.tensor(counts), capacity)
    held, room = [], capacity  # rays from the first on, as long as all before have room
    for count in counts:
        room -= count
        held.append(count if room >= 0 else 0)
    assert slots.counts.tolist() == held
    assert int(slots.left_out) == sum(sum(counts[: ray + 1]) > capacity for ray in range(len(counts)))
    sizes = slots.offsets.diff()
    assert slots.offsets[0] == 0
    assert slots.offsets[-1] == capacity
    assert torch.equal(slots.owners, torch.repeat_interleave(sizes))
    assert torch.equal(slots.ranks, torch.cat([torch.arange(int(size)) for size in sizes]))
    empty = sizes - slots.counts
    assert int(empty.min()) >= 0
    assert int(empty.max() - empty.min()) <= 1


def of_rays(placed: Placed) -> list[list[tuple[float, float]]]:
    """The intervals of each ray, without empty slots."""
    offsets, found = placed.slots.offsets.tolist(), []
    for first, count in zip(offsets, placed.slots.counts.tolist(), strict=False):
        here = slice(first, first + count)
        found.append(list(zip(placed.t_starts[here].tolist(), placed.t_ends[here].tolist(), strict=True)))
    return found


def truth(rays: Rays, grid: Occupancy, shift: Tensor | None) -> list[list[tuple[float, float]]]:
    starts, ends, _, offsets, _ = candidates(rays, grid, SIZE, 0.0, shift)
    pairs, bounds = list(zip(starts.tolist(), ends.tolist(), strict=True)), offsets.tolist()
    return [pairs[first:last] for first, last in pairwise(bounds)]


def moving(grid: Occupancy, rays: Rays) -> tuple[Rays, Occupancy]:
    """Two slices of time; the second is the opposite of the first."""
    times = torch.linspace(0, 1, len(rays))
    return replace(rays, times=times), replace(grid, occupied=torch.cat([grid.occupied, ~grid.occupied]), slices=2)


@pytest.mark.parametrize("slices", [1, 2])
@pytest.mark.parametrize(("resolution", "share"), [(5, 0.3), (16, 0.03), (8, 1.0), (8, 0.0)])
def test_slots_have_the_candidates_of_the_march(resolution: int, share: float, slices: int) -> None:
    rays, grid = random_rays(60), occupancy(resolution, share)
    if slices == 2:
        rays, grid = moving(grid, rays)
    shift = torch.rand(60, generator=torch.Generator().manual_seed(1))
    expected = truth(rays, grid, shift)
    found = fill_reference(rays, grid, SIZE, STEPS, shift, ROOMY)
    assert of_rays(found.placed) == expected
    assert int(found.left_out) == 0
    assert int(found.candidates) == sum(map(len, expected))
    assert max(map(len, expected)) <= most_steps(STEPS)
    assert int(found.placed.slots.offsets.diff().max()) <= longest_ray(found.placed.slots, STEPS)
    assert 8 * int(found.runs) >= int(found.candidates)
    slots, placed = found.placed.slots, found.placed
    empty = slots.ranks >= slots.counts[slots.owners]
    assert int(empty.sum()) == len(empty) - int(found.candidates)
    assert torch.equal(placed.t_starts[empty], placed.t_ends[empty])
    assert bool(placed.t_ends.isfinite().all())
    last = torch.tensor([each[-1][1] if each else 0.0 for each in expected])
    assert torch.equal(placed.t_ends[empty], last[slots.owners][empty])


@pytest.mark.parametrize("room", [(4096, 100), (40, 8192), (10, 50), (1, 1)])
def test_rays_without_room_are_left_out_whole_and_counted(room: tuple[int, int]) -> None:
    rays, grid = random_rays(60), occupancy(16, 0.3)
    expected = truth(rays, grid, None)
    everything = fill_reference(rays, grid, SIZE, STEPS, None, ROOMY)
    found = fill_reference(rays, grid, SIZE, STEPS, None, room)
    kept = of_rays(found.placed)
    assert all(some in ([], all_of_it) for some, all_of_it in zip(kept, expected, strict=True))
    missing = [ray for ray, (some, all_of_it) in enumerate(zip(kept, expected, strict=True)) if some != all_of_it]
    assert missing
    assert kept[missing[0] :] == [[]] * (len(kept) - missing[0])  # the first ones have room
    assert int(found.left_out) >= len(missing)
    assert int(found.runs) == int(everything.runs)  # the required number is known all the same
    if room[0] == 4096:
        assert int(found.candidates) == int(everything.candidates)


def test_light_ends_rays_where_the_definition_says() -> None:
    """Against a walk along each ray in Python's floats."""
    torch.manual_seed(0)
    rays, grid = random_rays(60), occupancy(8, 0.6)
    placed = fill(rays, grid, SIZE, STEPS, None, ROOMY).placed
    sigma = torch.rand(ROOMY[1]) * 6
    sigma[::97], sigma[50::101] = math.inf, math.nan
    for stop in (0.0, 1e-2, 0.5, 1.0):
        found = reach(placed, sigma, stop, STEPS).tolist()
        for ray, (first, count) in enumerate(
            zip(placed.slots.offsets.tolist(), placed.slots.counts.tolist(), strict=False)
        ):
            depth, reached, clear = 0.0, 0, True
            for slot in range(first, first + count):
                clear &= abs(depth + math.log(stop)) > 1e-4 if 0 < stop < 1 else True
                if stop > 0 and depth >= -math.log(stop):
                    break
                reached += 1
                length = float(placed.t_ends[slot] - placed.t_starts[slot])
                depth += 0 if math.isnan(float(sigma[slot])) else min(float(sigma[slot]) * length, 1e3)
            if clear:  # of rounding
                assert found[ray] == reached
            assert 0 <= found[ray] <= count


def test_empty_slots_show_nothing_and_learn_nothing() -> None:
    """Colours and gradients come from the samples alone, for any density in empty slots."""
    torch.manual_seed(1)
    rays, grid = random_rays(30), occupancy(8, 0.4)
    placed = fill(rays, grid, SIZE, STEPS, None, (4096, 2048)).placed
    slots = placed.slots
    full = slots.ranks < slots.counts[slots.owners]
    sigma, rgb = 5 * torch.rand(2048), torch.rand(2048, 3)
    sigma[~full] = 1e6
    offsets = torch.nn.functional.pad(slots.counts.cumsum(0), (1, 0))
    padded = Samples(placed.t_starts, placed.t_ends, slots.offsets, owners=slots.owners, filled=slots.counts.sum())
    alone = Samples(placed.t_starts[full], placed.t_ends[full], offsets)
    found, fars = [], rays.fars
    for samples, its_sigma, its_rgb in ((padded, sigma, rgb), (alone, sigma[full], rgb[full])):
        leaves = its_sigma.clone().requires_grad_(), its_rgb.clone().requires_grad_()
        out = composite(samples, *leaves, torch.ones(3).expand(30, 3), fars)
        (out.color.square().sum() + out.opacity.sum()).backward()
        found.append((out, [leaf.grad for leaf in leaves]))
    (one, its), (other, others) = found
    for name in ("color", "opacity", "moment", "median"):
        torch.testing.assert_close(getattr(one, name), getattr(other, name))
    for mine, theirs in zip(its, others, strict=True):
        assert mine is not None
        assert theirs is not None
        assert not mine[~full].any()
        torch.testing.assert_close(mine[full], theirs)
    assert int(padded.num_evaluated) == alone.num_evaluated == len(alone)
