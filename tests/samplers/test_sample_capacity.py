"""Training samples in a fixed number of slots: the same pictures and gradients, and enough capacity."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from benchmarks.operations import Counting
from nerfloom.geometry.rays import Rays
from nerfloom.kernels import native
from nerfloom.rendering.volume import VolumeRenderer
from nerfloom.samplers.occupancy import OccupancySampler
from nerfloom.samplers.sample_capacity import HEADROOM, MAX_SLOTS, SLOTS_MULTIPLE, SampleCapacity
from tests.samplers.test_occupancy import BOX, CountingField, KeptField, random_rays


def sampler(fixed: bool, **settings: object) -> OccupancySampler:
    made = OccupancySampler(BOX, resolution=16, num_steps=64, early_stop=1e-2, **settings)  # type: ignore[arg-type]
    made.occupied.copy_(torch.rand(len(made.occupied), generator=torch.Generator().manual_seed(3)) < 0.4)
    made.always_fixed = fixed
    made.forget()
    return made


def rendered(made: OccupancySampler, field: CountingField, rays: Rays) -> tuple[list[Tensor], Tensor]:
    """Colours, depths and opacities, and the gradient of the field's weights."""
    torch.manual_seed(5)
    samples = made.sample(rays, field, jitter=True)
    found = VolumeRenderer().shade(rays, samples, field, torch.tensor([0.2, 0.5, 0.9]))
    field.weight.grad = None
    (found.rgb.square().sum() + found.accumulation.sum()).backward()
    assert field.weight.grad is not None
    return [found.rgb, found.depth, found.median_depth, found.accumulation], field.weight.grad


@pytest.mark.parametrize("kind", [CountingField, KeptField])
@pytest.mark.parametrize("slices", [1, 4])
def test_pictures_and_gradients_are_those_of_the_march(
    kind: type[CountingField], slices: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A march with the same shift, on torch alone, so that rounding decides alike about steps on the faces of cells."""
    monkeypatch.setattr(native, "available", lambda: False)
    monkeypatch.setattr(native, "has", lambda name: False)
    rays, settings = random_rays(200), {"slices": slices, "moving": slices > 1}
    rays = replace(rays, times=torch.linspace(0, 1, 200)) if slices > 1 else rays
    (usual, slope), (found, its_slope) = (rendered(sampler(fixed, **settings), kind(), rays) for fixed in (False, True))
    for value, truth in zip(found, usual, strict=True):
        torch.testing.assert_close(value, truth, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(its_slope, slope, rtol=1e-4, atol=1e-4)


def test_a_step_waits_for_nothing_and_its_sizes_hold() -> None:
    made, field = sampler(True), CountingField()
    counts = set()
    for seed in range(4):
        made.sample(random_rays(100, seed), field, jitter=True)  # brings constants
        with Counting() as counting:
            samples = made.sample(random_rays(100, seed), field, jitter=True)
        assert not counting.waits
        counts.add((len(samples), samples.longest))
    assert len(counts) == 1
    before = made.step_kind(0)
    assert before.varies is None
    assert made.step_kind(9) == before
    made.read_counts()
    assert made.step_kind(10) != before  # there was capacity for every step of every ray
    assert len(made.sample(random_rays(100), field, jitter=True)) < counts.pop()[0]


def test_evaluation_and_no_rays_are_marched() -> None:
    made, field = sampler(True), CountingField()
    assert made.sample(random_rays(50)[:0], field, jitter=True).filled is None
    made.eval()
    assert made.sample(random_rays(50), field, jitter=False).filled is None


def test_what_is_derived_from_the_grid_stays_where_it_is() -> None:
    """Recorded steps look for it there; it follows the cells all the same."""
    made, field, rays = sampler(True), CountingField(), random_rays(100)
    made.occupied.fill_(False)
    made.occupied[:300] = True
    made.forget()
    made.sample(rays, field, jitter=False)
    (near,) = made.occupancy._near.values()
    before, grid = near.clone(), made.occupancy
    made.occupied.logical_not_()
    made.forget()
    assert made.occupancy is grid
    (after,) = made.occupancy._near.values()
    assert after.data_ptr() == near.data_ptr()
    assert not torch.equal(after, before)
    fresh = OccupancySampler(BOX, resolution=16, num_steps=64, early_stop=1e-2)
    fresh.occupied.copy_(made.occupied)
    fresh.always_fixed = True
    samples = [each.sample(rays, field, jitter=False) for each in (made, fresh)]
    assert torch.equal(samples[0].t_starts, samples[1].t_starts)
    usual = sampler(False)
    usual.occupied.copy_(made.occupied)
    usual.forget()
    assert samples[0].num_evaluated == len(usual.sample(rays, field, jitter=False))


def noted(capacity: SampleCapacity, rays: int, *needed: int, left_out: int = 0) -> None:
    capacity.note(rays, tuple(map(torch.tensor, needed)), torch.tensor(left_out))  # type: ignore[arg-type]


def test_room_follows_the_most_that_was_needed_and_mostly_stays() -> None:
    capacity = SampleCapacity(runs=10, steps=66)
    assert capacity.of(1000) == (10_240, 66_048, 66_048)
    capacity.read()  # nothing was noted
    assert capacity.per_ray == (10, 66, 66)
    noted(capacity, 1000, 3000, 20_000, 4000)
    noted(capacity, 1000, 2000, 24_000, 1000)
    capacity.read()
    assert capacity.per_ray == pytest.approx((HEADROOM * 3, HEADROOM * 24, HEADROOM * 4))
    given = capacity.per_ray
    noted(capacity, 1000, 2500, 26_000, 3500)  # fits, by little, and not far too roomy
    capacity.read()
    assert capacity.per_ray == given
    noted(capacity, 1000, 2500, 40_000, 100, left_out=30)
    capacity.read()
    assert capacity.per_ray == pytest.approx((given[0], HEADROOM * 40, HEADROOM * 1))
    assert (capacity.rays, capacity.left_out) == (4000, 30)
    sizes = [size for rays in (1, 999, 2**17) for size in capacity.of(rays)]
    assert all(size % SLOTS_MULTIPLE == 0 and size <= MAX_SLOTS for size in sizes)
    assert min(capacity.of(1)) == SLOTS_MULTIPLE


def test_nothing_is_known_of_a_run_that_goes_on() -> None:
    """Its first step must not need the memory of all steps of all its rays."""
    capacity = SampleCapacity(runs=65, steps=514)
    assert capacity.of(10_000) == (650_240, MAX_SLOTS, MAX_SLOTS)
    assert capacity.of(10_000, usual=2**15) == (650_240, MAX_SLOTS, 2**17)
    assert capacity.of(128, usual=2**15).kept == 65_792  # the first of a new run
