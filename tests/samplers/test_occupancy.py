"""The occupancy sampler: nothing that matters is skipped, nothing is evaluated twice."""

import pytest
import torch

from nerfloom.base.errors import ConfigError
from nerfloom.fields.base import Field
from nerfloom.geometry.bounds import intersect_box
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels import native
from nerfloom.kernels.networks.mlp import mlp
from nerfloom.rendering.volume import volume_render
from nerfloom.samplers.occupancy import WARM_UP_STEPS, OccupancySampler

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])


def random_rays(count: int, seed: int = 0, near: float = 0.0) -> Rays:
    """Rays from a sphere of radius 3 towards points in and near the box."""
    generator = torch.Generator().manual_seed(seed)
    origins = torch.randn(count, 3, generator=generator)
    origins = 3 * origins / origins.norm(dim=-1, keepdim=True)
    directions = torch.rand(count, 3, generator=generator) * 3 - 1.5 - origins
    directions = directions / directions.norm(dim=-1, keepdim=True)
    return Rays(origins, directions, torch.full((count,), near), torch.full((count,), 10.0))


def ball_density(radius: float, sigma: float = 50.0):
    def density(points: Points) -> tuple[torch.Tensor, torch.Tensor]:
        inside = points.positions.norm(dim=-1) < radius
        return inside * sigma, points.positions

    return density


class Transparent(Field):
    """Nothing anywhere: every candidate is a sample."""

    def density(self, points: Points):
        return torch.zeros(len(points)), points.positions

    def color(self, features, directions, camera_indices=None):
        return features


@pytest.mark.parametrize("jitter", [True, False])
def test_a_full_grid_covers_each_rays_chord(jitter: bool) -> None:
    torch.manual_seed(0)
    rays = random_rays(300)
    sampler = OccupancySampler(BOX, resolution=16, num_steps=100)
    samples = sampler.sample(rays, Transparent(), jitter)
    enter, leave = intersect_box(rays.origins, rays.directions, BOX)
    lengths = torch.zeros(300).index_add(0, samples.ray_indices, samples.deltas)
    assert bool(((lengths - (leave - enter)).abs() <= 1.001 * sampler.step_size).all())
    assert bool((samples.t >= enter[samples.ray_indices] - 1e-5).all())
    assert bool((samples.t <= leave[samples.ray_indices] + 1e-5).all())


def test_steps_may_be_shorter_outside_of_training() -> None:
    """Then the samples equal a grid's with more steps, and in training they are unchanged."""
    rays = random_rays(50)
    both = OccupancySampler(BOX, resolution=16, num_steps=60, eval_step_scale=0.5)
    grids = {True: OccupancySampler(BOX, resolution=16, num_steps=60), False: OccupancySampler(BOX, 16, num_steps=120)}
    for training, alone in grids.items():
        found, expected = (grid.train(training).sample(rays, Transparent(), False) for grid in (both, alone))
        assert len(found.t) > 100
        torch.testing.assert_close(found.t, expected.t)
        torch.testing.assert_close(found.deltas, expected.deltas)


@pytest.mark.parametrize(("resolution", "num_steps"), [(8, 64), (32, 128), (64, 64), (16, 512)])
def test_skipping_finds_exactly_the_occupied_steps(resolution: int, num_steps: int) -> None:
    """Brute force over every step; only steps within rounding of a cell's face may differ."""
    rays = random_rays(200, seed=1)
    sampler = OccupancySampler(BOX, resolution=resolution, num_steps=num_steps)
    sampler.occupied.copy_(torch.rand(resolution**3, generator=torch.Generator().manual_seed(2)) < 0.02)
    sampler.forget()
    samples = sampler.sample(rays, Transparent(), jitter=False)
    quarter = sampler.step_size / 4
    found = {(int(r), round(float(t) / quarter)) for r, t in zip(samples.ray_indices, samples.t, strict=True)}

    enter, leave = (v.double() for v in intersect_box(rays.origins, rays.directions, BOX))
    occupied = sampler.occupied.view(resolution, resolution, resolution)
    missed = extra = 0
    for step in range(num_steps + 1):
        t = enter + (step + 0.5) * sampler.step_size
        cell = (rays.origins + t[:, None] * rays.directions + 1) / 2 * resolution
        clear = ((cell - cell.round()).abs() > 1e-3).all(-1) & ((t - leave).abs() > 1e-4)
        index = cell.floor().long().clamp(0, resolution - 1)
        truth = occupied[index[:, 0], index[:, 1], index[:, 2]] & (t < leave)
        for ray in clear.nonzero().squeeze(-1).tolist():
            has = (ray, round(float(t[ray]) / quarter)) in found
            missed += bool(truth[ray]) and not has
            extra += has and not bool(truth[ray])
    assert (missed, extra) == (0, 0)
    assert len(found) > 20


class CountingField(Field):
    """Random but fixed densities; it counts evaluations."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.randn(3, 4, generator=torch.Generator().manual_seed(0)) * 3)
        self.asked: list[torch.Tensor] = []

    def density(self, points: Points):
        self.asked.append(points.positions.detach())
        features = (points.positions @ self.weight).sin()
        return 8 * features[:, 0].clamp(min=0) ** 2, features

    def color(self, features, directions, camera_indices=None):
        return features[:, :3] * 0.5 + 0.5


class KeptField(CountingField):
    """The same by an operation of ours; its results are kept for the backward pass."""

    def density(self, points: Points):
        self.asked.append(points.positions.detach())
        features = mlp([points.positions], [self.weight.t()]).sin()
        return 8 * features[:, 0].clamp(min=0) ** 2, features


@pytest.mark.parametrize("kind", [CountingField, KeptField])
def test_waves_without_early_stop_equal_one_evaluation(kind) -> None:
    rays = random_rays(60)
    sampler = OccupancySampler(BOX, resolution=8, num_steps=90, early_stop=0.0)
    candidates = sampler.sample(rays, Transparent(), jitter=False)
    field = kind()
    waves = sampler.sample(rays, field, jitter=False)
    asked = field.asked[:-1] if kind is KeptField and native.available() else field.asked  # the last computes nothing
    assert sum(len(a) for a in asked) == len(candidates)
    assert torch.cat(asked).unique(dim=0).shape[0] == len(candidates)  # nothing twice
    sigma, features = field.density(Points(candidates.positions(rays)))
    torch.testing.assert_close(waves.sigma, sigma)
    torch.testing.assert_close(waves.features, features)
    torch.testing.assert_close(waves.t_starts, candidates.t_starts)
    assert waves.offsets.tolist() == candidates.offsets.tolist()
    assert waves.sigma is not None
    (by_waves,) = torch.autograd.grad(waves.sigma.square().sum(), field.weight, retain_graph=True)
    (at_once,) = torch.autograd.grad(sigma.square().sum(), field.weight)
    torch.testing.assert_close(by_waves, at_once, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("early_stop", [1e-1, 1e-3])
def test_early_stop_keeps_its_bound_and_saves(early_stop: float) -> None:
    rays = random_rays(400)
    field = CountingField()

    def render(stop: float) -> tuple[torch.Tensor, int]:
        sampler = OccupancySampler(BOX, resolution=8, num_steps=400, early_stop=stop)
        samples = sampler.sample(rays, field, jitter=False)
        assert samples.sigma is not None
        assert samples.features is not None
        colors = field.color(samples.features, None)
        return volume_render(rays, samples, samples.sigma, colors, torch.ones(3)).rgb, len(samples)

    (full, all_samples), (stopped, fewer) = render(0.0), render(early_stop)
    worst = (full - stopped).abs().max().item()
    print(f"early stop at {early_stop:g}: colour off by at most {worst:.1e}, {fewer / all_samples:.0%} of the samples")
    assert 0 < worst <= early_stop
    assert fewer < all_samples


@pytest.mark.parametrize("kind", [CountingField, KeptField])
def test_rays_that_meet_nothing(kind) -> None:
    sampler = OccupancySampler(BOX, resolution=8, num_steps=32)
    away = Rays(torch.full((3, 3), 5.0), torch.eye(3), torch.zeros(3), torch.full((3,), 10.0))
    field = kind()
    for rays in (away, away[:0]):
        samples = sampler.sample(rays, field, jitter=True)
        assert len(samples) == 0
        assert samples.num_rays == len(rays)
        assert samples.features is not None
    sampler.occupied.zero_()
    sampler.forget()
    assert len(sampler.sample(random_rays(10), field, jitter=True)) == 0


def train_grid(sampler: OccupancySampler, density, steps: range) -> None:
    for step in steps:
        if step % 8 == 0:  # in the others nothing is drawn, and seeding takes longer than all else
            torch.manual_seed(step)
        sampler.update(step, density)


@pytest.mark.medium
def test_the_grid_learns_a_ball_and_notices_when_it_grows() -> None:
    resolution = 16
    sampler = OccupancySampler(BOX, resolution=resolution, num_steps=64)
    train_grid(sampler, ball_density(0.5), range(WARM_UP_STEPS + 1))
    centers = (torch.cartesian_prod(*[torch.arange(resolution)] * 3) + 0.5) / resolution * 2 - 1
    half_diagonal = 3**0.5 / resolution
    distance = centers.norm(dim=-1)
    well_inside, well_outside = distance < 0.5 - half_diagonal, distance > 0.5 + half_diagonal
    assert bool(sampler.occupied[well_inside].all())
    assert not bool(sampler.occupied[well_outside].any())
    train_grid(sampler, ball_density(0.8), range(WARM_UP_STEPS + 1, WARM_UP_STEPS + 16 * 600))
    assert bool(sampler.occupied[distance < 0.8 - half_diagonal].all())


def test_state_survives_a_checkpoint() -> None:
    sampler = OccupancySampler(BOX, resolution=16, num_steps=64)
    train_grid(sampler, ball_density(0.5), range(WARM_UP_STEPS))
    copy = OccupancySampler(BOX, resolution=16, num_steps=64)
    copy.load_state_dict(sampler.state_dict())
    rays = random_rays(50)
    first, second = (s.sample(rays, Transparent(), jitter=False) for s in (sampler, copy))
    assert isinstance(first, Samples)
    torch.testing.assert_close(first.t_starts, second.t_starts, rtol=0, atol=0)
    assert first.offsets.tolist() == second.offsets.tolist()


def test_slices_of_time_hold_what_is_there_at_their_time() -> None:
    """A ball crosses the box in 8 slices: its cells of a slice are the cells that it touches in that time."""

    def density(points: Points) -> tuple[torch.Tensor, torch.Tensor]:
        assert points.times is not None
        center = torch.zeros(len(points), 3)
        center[:, 0] = points.times * 1.6 - 0.8
        return ((points.positions - center).norm(dim=-1) < 0.3).float() * 100, points.positions

    sampler = OccupancySampler(BOX, 16, 64, moving=True, slices=8)
    train_grid(sampler, density, range(1, 3000))
    centers = (torch.cartesian_prod(*[torch.arange(16)] * 3) + 0.5) / 8 - 1
    ends = torch.linspace(-0.8, 0.8, 9)
    found = sampler.occupied.view(8, -1)
    for index, (start, end) in enumerate(zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)):
        nearest = torch.stack([centers[:, 0].clamp(start, end), *torch.zeros(2, len(centers))], -1)
        middle = torch.tensor([(start + end) / 2, 0, 0])
        assert found[index][(centers - middle).norm(dim=-1) < 0.2].float().mean() > 0.95
        assert not bool(found[index][(centers - nearest).norm(dim=-1) > 0.3 + 3**0.5 / 16].any())
        assert torch.equal(sampler.occupied_when((index + 0.5) / 8), found[index])
    assert torch.equal(sampler.occupied_when(), found.any(0))
    assert torch.equal(sampler.occupied_when(1.0), found[-1])


def test_slices_are_carved_one_by_one_or_all_alike() -> None:
    sampler = OccupancySampler(BOX, 4, 16, moving=True, slices=2)
    hull = torch.rand(2 * 64, generator=torch.Generator().manual_seed(0)) > 0.5
    sampler.carve(hull)
    assert torch.equal(sampler.occupied, hull)
    sampler.carve(hull[:64])
    assert torch.equal(sampler.carved, ~hull[:64].repeat(2))
    with pytest.raises(ConfigError, match="2 slices of time"):
        OccupancySampler(BOX, 4, 16, slices=2)


@pytest.mark.medium
def test_a_cell_that_is_full_for_a_short_while_stays() -> None:
    """A ball that is there for a twentieth of the time: its cells are kept, and cells that are never full are not."""

    def density(points: Points) -> tuple[torch.Tensor, torch.Tensor]:
        assert points.times is not None
        there = (points.positions.norm(dim=-1) < 0.6) & (points.times < 0.05)
        return there.float() * 100, points.positions

    box = torch.tensor([[-1.0] * 3, [1.0] * 3])
    sampler = OccupancySampler(box, 16, 64, moving=True)
    train_grid(sampler, density, range(1, 4000))
    centers = (torch.cartesian_prod(*[torch.arange(16)] * 3) + 0.5) / 8 - 1
    assert sampler.occupied[centers.norm(dim=-1) < 0.5].float().mean() > 0.95
    assert not bool(sampler.occupied[centers.norm(dim=-1) > 0.75].any())


@pytest.mark.parametrize("carved", [0.0, 0.3, 0.95, 1.0])
def test_updates_visit_all_cells_that_are_not_carved_and_no_others(carved: float) -> None:
    torch.manual_seed(0)
    sampler = OccupancySampler(BOX, 16, 100)
    hull = torch.rand(16**3) >= carved
    sampler.carve(hull)
    asked: list[torch.Tensor] = []

    def density(points: Points) -> tuple[torch.Tensor, torch.Tensor]:
        asked.append(points.positions)
        return torch.full((len(points),), 50.0), points.positions

    for step in range(WARM_UP_STEPS + 640):
        sampler.update(step, density)
    cells = ((torch.cat(asked) + 1) * 8).long().clamp(0, 15)
    visited = torch.bincount((cells[:, 0] * 16 + cells[:, 1]) * 16 + cells[:, 2], minlength=16**3) > 0
    assert torch.equal(visited, hull)
    assert torch.equal(sampler.occupied, hull)


def test_what_is_carved_later_or_loaded_is_no_longer_visited() -> None:
    torch.manual_seed(0)
    sampler, other = OccupancySampler(BOX, 8, 50), OccupancySampler(BOX, 8, 50)
    assert sampler.kept() == (512, None)
    half = torch.arange(512) < 256
    sampler.carve(half)
    assert other.kept() == (512, None)
    other.load_state_dict(sampler.state_dict())
    for each in (sampler, other):
        count, cells = each.kept()
        assert count == 256
        assert cells is not None
        assert torch.equal(cells.long(), torch.arange(256))
