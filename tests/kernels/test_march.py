"""Marching: the compiled and the torch form hand out the same samples, wave by wave."""

import math
from dataclasses import replace

import pytest
import torch

from nerfloom.geometry.rays import Rays
from nerfloom.kernels import native
from nerfloom.kernels.march.occupancy import Occupancy, refresh_occupancy, refresh_occupancy_reference
from nerfloom.kernels.march.ray_order import sort_by_ray
from nerfloom.kernels.march.waves import CompiledMarch, ReferenceMarch, candidates, step_start
from tests.kernels.compiled import needs_kernels

BOX = torch.tensor([[-1.0, -1.5, -1.0], [1.0, 1.0, 2.0]])


def random_rays(count: int, seed: int = 0) -> Rays:
    generator = torch.Generator().manual_seed(seed)
    origins = torch.randn(count, 3, generator=generator)
    origins = 4 * origins / origins.norm(dim=-1, keepdim=True)
    directions = torch.rand(count, 3, generator=generator) * 3 - 1.5 - origins
    directions = directions / directions.norm(dim=-1, keepdim=True)
    rays = Rays(origins, directions, torch.full((count,), 0.1), torch.full((count,), 20.0))
    rays.origins[:6] = torch.eye(3).repeat(2, 1) * 3.0  # along the axes, and from inside
    rays.directions[:6] = torch.cat([-torch.eye(3), torch.eye(3)])
    rays.origins[6] = torch.tensor([0.1, 0.2, 0.3])
    return rays


def occupancy(resolution: int, share: float, seed: int = 0) -> Occupancy:
    generator = torch.Generator().manual_seed(seed)
    return Occupancy(torch.rand(resolution**3, generator=generator) < share, BOX, resolution)


def walk(march, limit: int = 16, sigma: float = 0.0):
    """Samples of all waves, ray by ray: starts, ends, owners, offsets."""
    while (wave := march.wave(limit)) is not None:
        march.advance(torch.full_like(wave.t_starts, sigma))
        middle = (wave.t_starts + wave.t_ends) / 2
        torch.testing.assert_close(wave.positions, march.rays.points(wave.owners, middle), rtol=1e-5, atol=1e-5)
    order, offsets = march.finish()
    if not march.waves:
        return [torch.zeros(0), torch.zeros(0), torch.zeros(0, dtype=torch.int64), offsets]
    columns = [torch.cat([getattr(w, n) for w in march.waves]) for n in ("t_starts", "t_ends", "owners")]
    return [column[order] for column in columns] + [offsets]


@needs_kernels
@pytest.mark.parametrize("cone", [0.0, 1 / 64])
@pytest.mark.parametrize(("resolution", "share"), [(5, 0.3), (16, 0.03), (33, 0.02), (64, 0.01), (64, 1.0), (8, 0.0)])
def test_compiled_finds_what_the_reference_finds(resolution: int, share: float, cone: float) -> None:
    """Rounding decides about steps with the middle on a cell's face: less than one in a thousand."""
    rays, grid = random_rays(300), occupancy(resolution, share)
    shift = torch.rand(300, generator=torch.Generator().manual_seed(1))
    found = []
    for kind in (CompiledMarch, ReferenceMarch):
        starts, ends, owners, _ = walk(kind(rays, grid, 0.02, cone, shift, 0.0))
        key = zip(owners.tolist(), ((starts + ends) / 2 / 1e-3).round().tolist(), strict=True)
        assert bool((ends > starts).all())
        found.append(set(key))
    compiled, reference = found
    near = {(r, t + d) for r, t in reference for d in (-1, 0, 1)}
    missed = {(r, t) for r, t in reference if not {(r, t - 1), (r, t), (r, t + 1)} & compiled}
    extra = compiled - near
    assert len(missed) + len(extra) <= 1e-3 * len(reference) + 1
    assert (len(reference) > 50) == (share > 0)


@needs_kernels
@pytest.mark.parametrize("sigma", [0.0, 3.0, 1e4, float("nan")])
def test_light_ends_rays_at_the_same_sample(sigma: float) -> None:
    rays, grid = random_rays(200), occupancy(8, 0.5)
    compiled, reference = (
        walk(kind(rays, grid, 0.05, 0.0, None, 1e-3), 8, sigma) for kind in (CompiledMarch, ReferenceMarch)
    )
    differing = (compiled[3].diff() - reference[3].diff()).abs()
    assert int((differing > 1).sum()) == 0
    assert int((differing > 0).sum()) <= 4
    if sigma == 3.0:  # tau = 0.15 a sample: those begin before ln(1000) is spent
        assert int(compiled[3].diff().max()) == math.ceil(math.log(1000) / 0.15)


@needs_kernels
def test_hidden_samples_are_never_handed_out() -> None:
    """An opaque wall: only the first wave of each ray is evaluated."""
    rays, grid = random_rays(100), occupancy(8, 1.0)
    march = CompiledMarch(rays, grid, 0.01, 0.0, None, 1e-4)
    wave = march.wave(8)
    assert wave is not None
    march.advance(torch.full_like(wave.t_starts, 1e6))
    assert march.wave(8) is None
    order, offsets = march.finish()
    assert int(offsets.diff().max()) == 1  # all but the first sample lie behind it
    assert len(order) == int((march.leave > march.enter).sum())


@pytest.mark.parametrize("kind", [CompiledMarch, ReferenceMarch])
def test_a_nan_ray_does_not_show_what_is_hidden_on_others(kind) -> None:
    if kind is CompiledMarch and not native.available():
        pytest.skip("the compiled kernels are not installed")
    march = kind(random_rays(100), occupancy(8, 1.0), 0.01, 0.0, None, 1e-4)
    wave = march.wave(8)
    assert wave is not None
    first = int(wave.owners[0])
    sigma = torch.full_like(wave.t_starts, 1e6)
    sigma[wave.owners == first] = math.nan
    march.advance(sigma)
    counts = march.finish()[1].diff()
    assert int(counts[first]) == int((wave.owners == first).sum()) > 1
    assert int(counts[torch.arange(100) != first].max()) == 1


@pytest.mark.parametrize("kind", [CompiledMarch, ReferenceMarch])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_ray_that_is_nowhere_ends_at_once(kind, axis: int) -> None:
    """Without a far end, a march along it would not end."""
    if kind is CompiledMarch and not native.available():
        pytest.skip("the compiled kernels are not installed")
    rays = random_rays(20)
    rays.fars[:] = math.inf
    rays.origins[10, axis] = rays.directions[11, axis] = rays.origins[12, axis] = math.nan
    rays.directions[12, axis] = 0  # and along a face
    rays.origins[13, axis] = math.inf
    _, _, owners, offsets = walk(kind(rays, occupancy(8, 1.0), 0.05, 0.0, None, 0.0))
    assert len(owners) > 100
    assert offsets.diff()[10:14].tolist() == [0, 0, 0, 0]


@needs_kernels
def test_threads_hand_out_the_same_samples() -> None:
    rays, grid, found = random_rays(500), occupancy(32, 0.05), []
    before = torch.get_num_threads()
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            found.append(walk(CompiledMarch(rays, grid, 0.01, 0.0, None, 1e-4), sigma=5.0))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for other in found[1:] for a, b in zip(found[0], other, strict=True))


@pytest.mark.parametrize("kind", [CompiledMarch, ReferenceMarch])
def test_nothing_to_do(kind) -> None:
    if kind is CompiledMarch and not native.available():
        pytest.skip("the compiled kernels are not installed")
    away = Rays(torch.full((3, 3), 5.0), torch.eye(3), torch.zeros(3), torch.full((3,), 10.0))
    for rays, grid in ((away, occupancy(8, 1.0)), (away[:0], occupancy(8, 1.0)), (random_rays(20), occupancy(8, 0.0))):
        march = kind(rays, grid, 0.1, 0.0, None, 1e-4)
        while (wave := march.wave(8)) is not None:
            assert len(wave.owners) == 0
            march.advance(torch.zeros(0))
        order, offsets = march.finish()
        assert len(order) == 0
        assert offsets.tolist() == [0] * (len(rays) + 1)


def test_cone_steps_are_even_and_then_geometric() -> None:
    first, step, cone = torch.tensor([0.5], dtype=torch.float64), 0.01, 1 / 256
    starts = step_start(first, torch.arange(2000), step, cone)
    lengths = starts.diff()
    near = starts[1:] < step / cone
    torch.testing.assert_close(lengths[near], torch.full_like(lengths[near], step), rtol=1e-9, atol=0)
    far = starts[:-1] > step / cone + step
    torch.testing.assert_close((lengths / starts[:-1])[far], torch.full_like(lengths[far], cone), rtol=1e-9, atol=0)


@pytest.mark.parametrize("kind", [CompiledMarch, ReferenceMarch])
def test_each_ray_marches_through_the_slice_of_its_time(kind) -> None:
    """The result equals a march through a grid with this slice alone; 5^3 cells do not fill whole bytes."""
    if kind is CompiledMarch and not native.available():
        pytest.skip("the compiled kernels are not installed")
    slices, resolution = 3, 5
    parts = [occupancy(resolution, 0.3, seed).occupied for seed in range(slices)]
    rays = random_rays(300)
    times = torch.rand(300, generator=torch.Generator().manual_seed(2))
    times[:4] = torch.tensor([0.0, 1 / 3, 2 / 3, 1.0])  # a slice begins with its first moment, and the last has 1
    timed = replace(rays, times=times)
    found = walk(kind(timed, Occupancy(torch.cat(parts), BOX, resolution, slices=slices), 0.05, 0.0, None, 0.0))
    for index, part in enumerate(parts):
        mine = (times >= index / slices) & (times < (index + 1) / slices) | (times == 1) * (index == slices - 1)
        alone = walk(kind(rays, Occupancy(part, BOX, resolution), 0.05, 0.0, None, 0.0))
        assert int(mine.sum()) > 50
        for here, truth in zip(found[:2], alone[:2], strict=True):
            assert torch.equal(here[mine[found[2]]], truth[mine[alone[2]]])


def test_a_grid_with_slices_needs_times() -> None:
    with pytest.raises(ValueError, match="needs the times of rays"):
        Occupancy(torch.ones(2 * 8, dtype=torch.bool), BOX, 2, slices=2).slices_of(None)


def test_candidates_lie_inside_the_box_and_the_bounds() -> None:
    rays, grid = random_rays(200), occupancy(16, 1.0)
    starts, ends, owners, offsets, longest = candidates(rays, grid, 0.05, 1 / 32, None)
    assert torch.equal(owners, torch.repeat_interleave(torch.arange(200), offsets.diff()))
    assert longest == int(offsets.diff().max())
    points = rays.points(owners, (starts + ends) / 2)
    assert bool(((points > BOX[0] - 1e-4) & (points < BOX[1] + 1e-4)).all())


def test_sorting_keeps_reached_samples_in_order() -> None:
    owners = torch.tensor([0, 2, 2, 0, 2, 3, 0])
    reached = torch.tensor([1, 1, 0, 1, 1, 0, 1], dtype=torch.uint8)
    order, offsets = sort_by_ray(owners, reached, 5)
    assert order.tolist() == [0, 3, 6, 1, 4]
    assert offsets.tolist() == [0, 3, 3, 5, 5, 5]


@pytest.mark.parametrize("mean_is_less", [True, False])
def test_refreshing_marks_cells_by_opacity(mean_is_less: bool) -> None:
    torch.manual_seed(0)
    density = torch.rand(20**3) * 10.0 ** torch.randint(-5, 3 if not mean_is_less else -1, (20**3,)).float()
    density[7] = torch.inf if not mean_is_less else 0
    truth = density.double() * 0.9
    alpha = -torch.expm1(-truth * 0.05)
    threshold = min(0.01, alpha.mean().item())
    assert (threshold < 0.01) == mean_is_less
    occupied = torch.zeros(20**3, dtype=torch.bool)
    refresh_occupancy(density, occupied, 0.9, 0.05, 0.01)
    torch.testing.assert_close(density.double(), truth)
    clear = (alpha / threshold - 1).abs() > 1e-3
    assert torch.equal(occupied[clear], (alpha >= threshold)[clear])
    assert 0 < int(occupied.sum()) < 20**3


@pytest.mark.parametrize("refresh", [refresh_occupancy, refresh_occupancy_reference])
def test_a_mean_of_other_cells_empties_what_is_thinner(refresh) -> None:
    """Fog of opacity 1e-4 stays by its own mean, and goes by a larger one, up to the threshold; NaN always stays."""
    for elsewhere, kept in ((0.0, 999), (5e-5, 999), (2e-4, 10), (0.5, 5)):
        density, occupied = torch.full((999,), 1e-3), torch.zeros(999, dtype=torch.bool)
        density[:10], density[:5], density[0] = 0.05, 0.2, math.nan
        if elsewhere < 1e-4:
            density.fill_(1e-3)
        refresh(density, occupied, 1.0, 0.1, 0.01, elsewhere)
        assert int(occupied.sum()) == kept
