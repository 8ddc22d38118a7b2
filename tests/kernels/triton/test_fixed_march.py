"""Marching into slots: rays and samples as the reference's in float64, none lost, and none invented."""

import math
from dataclasses import replace

import pytest
import torch

from nerfloom.kernels.march.fixed_slots import Placed, Slots, fill, fill_reference, reach, reach_reference, share_out
from tests.kernels.test_fixed_march import ROOMY, SIZE, STEPS, of_rays
from tests.kernels.test_march import occupancy, random_rays
from tests.kernels.triton.compared import DEVICE, backends
from tests.kernels.triton.test_march import in_float64, on_device


@pytest.mark.parametrize(
    ("resolution", "share", "slices"),
    [
        pytest.param(5, 0.3, 1, marks=pytest.mark.slow), (5, 0.3, 2), (33, 0.05, 1), (8, 1.0, 1),
        pytest.param(8, 0.0, 2, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_slots_have_the_references_candidates(resolution: int, share: float, slices: int) -> None:
    """Rounding decides about steps with the middle on a cell's face: one in a hundred, and one."""
    rays, grid = random_rays(33), occupancy(resolution, share)
    if slices == 2:
        rays = replace(rays, times=torch.linspace(0, 1, 33))
        grid = replace(grid, occupied=torch.cat([grid.occupied, ~grid.occupied]), slices=2)
    shift = torch.rand(33, generator=torch.Generator().manual_seed(1))
    with backends() as names:
        filled = fill(*on_device(rays, grid), SIZE, STEPS, shift.to(DEVICE), ROOMY)
    assert names == ["triton"]
    truth = fill_reference(*in_float64(rays, grid), SIZE, STEPS, shift.double(), ROOMY)
    pairs = [of_rays(each.placed) for each in (filled, truth)]
    found = [{(ray, round(a / 1e-2)) for ray, each in enumerate(rays_) for a, _ in each} for rays_ in pairs]
    near = [{(r, t + d) for r, t in samples for d in (-1, 0, 1)} for samples in found]
    assert len(found[0] - near[1]) + len(found[1] - near[0]) <= 1e-2 * len(found[1]) + 1
    assert (len(found[1]) > 5) == (share > 0 or slices == 2)
    assert int(filled.candidates) == sum(map(len, pairs[0]))
    slots, placed = filled.placed.slots, filled.placed
    empty = slots.ranks >= slots.counts[slots.owners]
    assert torch.equal(placed.t_starts[empty], placed.t_ends[empty])
    assert bool(placed.t_ends.isfinite().all())


def test_rays_without_room_are_left_out_whole() -> None:
    rays, grid = on_device(random_rays(33), occupancy(8, 0.6))
    everything = of_rays(fill(rays, grid, SIZE, STEPS, None, ROOMY).placed)
    filled = fill(rays, grid, SIZE, STEPS, None, (0, 150))
    kept, room = [], 150
    for samples in everything:
        room -= len(samples)
        kept.append(samples if room >= 0 else [])
    assert of_rays(filled.placed) == kept
    assert 0 < sum(map(len, kept)) <= 150 < int(filled.candidates) == sum(map(len, everything))
    assert int(filled.left_out) == sum(sum(map(len, everything[: ray + 1])) > 150 for ray in range(33))


@pytest.mark.parametrize("density", ["random", "nothing", "opaque", "infinite and NaN"])
@pytest.mark.parametrize("stop", [0.0, 1e-2, 1.0])
def test_light_reaches_as_many_as_in_the_reference(density: str, stop: float) -> None:
    torch.manual_seed(0)
    slots = share_out(torch.randint(0, 20, (33,)), 700)
    ends = torch.rand(700).cumsum(0) / 50
    placed = Placed.of(ends - 0.02, ends, slots.counts.cumsum(0) - slots.counts, slots)
    sigma = 100 * torch.rand(700)
    if density == "infinite and NaN":
        sigma[::13], sigma[5::29] = math.inf, math.nan
    elif density != "random":
        sigma.fill_(0.0 if density == "nothing" else 1e9)
    exact = Placed(slots, placed.t_starts.double(), placed.t_ends.double())
    budget = -math.log(stop) if stop else math.inf
    truth = reach_reference(exact, sigma.double(), budget, STEPS)
    there = Placed(
        Slots(*(part.to(DEVICE) for part in vars(slots).values())),
        placed.t_starts.to(DEVICE),
        placed.t_ends.to(DEVICE),
    )  # fmt: skip
    with backends() as names:
        found = reach(there, sigma.to(DEVICE), stop, STEPS).cpu()
    assert names == ["triton"]
    assert torch.equal(found, truth)
    assert bool((found <= slots.counts).all())
