"""Proposals: places of samples, and training to bound the density."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from nerfloom.fields.base import Field
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.histograms.spacing import from_disparity, to_disparity
from nerfloom.rendering.rendered import Rendered
from nerfloom.rendering.volume import VolumeRenderer
from nerfloom.samplers.proposal import ENDLESS_FAR, ProposalSampler, interlevel_loss

BOX = torch.tensor([[-1.0] * 3, [1.0] * 3])


class Wall(Field):
    """Opaque in a slab of x; grey."""

    def __init__(self, low: float, high: float) -> None:
        super().__init__()
        self.low, self.high = low, high

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        x = points.positions[:, 0]
        return 200.0 * ((x > self.low) & (x < self.high)), points.positions

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return torch.full_like(features, 0.5)


def rays_along_x(count: int, near: float = 0.05, far: float = 1000.0) -> Rays:
    torch.manual_seed(0)
    origins = torch.cat([torch.full((count, 1), -0.9), torch.rand(count, 2) - 0.5], dim=-1)
    directions = torch.tensor([[1.0, 0.0, 0.0]]).expand(count, 3)
    return Rays(origins, directions, torch.full((count,), near), torch.full((count,), far))


def shown(field: Field, sampler: ProposalSampler, rays: Rays, background: float, jitter: bool) -> Rendered:
    samples = sampler.sample(rays, field, jitter)
    return VolumeRenderer().render(rays, samples, field, torch.full((3,), background))


def test_disparity_is_inverted_and_continuous() -> None:
    t = torch.logspace(-6, 6, 200, dtype=torch.float64)
    torch.testing.assert_close(from_disparity(to_disparity(t)), t)
    assert to_disparity(torch.tensor(1.0)) == 0.5
    assert bool(torch.isfinite(from_disparity(to_disparity(torch.tensor([0.0, torch.inf])))).all())


@pytest.mark.parametrize("unbounded", [True, False])
@pytest.mark.parametrize("jitter", [True, False])
@pytest.mark.parametrize("count", [0, 17])
def test_samples_are_sorted_and_between_the_ends(unbounded: bool, jitter: bool, count: int) -> None:
    sampler = ProposalSampler(BOX, (24, 12, 8), unbounded=unbounded)
    rays = rays_along_x(count)
    samples = sampler.sample(rays, Wall(0, 1), jitter)
    assert samples.per_ray == 8
    assert len(samples) == 8 * count
    t = samples.padded(samples.t)
    assert bool((t.diff(dim=-1) >= 0).all())
    far = 1000.0 if unbounded else 1.9
    assert bool((t >= 0.05 - 1e-6).all())
    assert bool((t <= far * (1 + 1e-4)).all())
    assert samples.edges is not None
    assert samples.edges.shape == (count, 9)


def test_a_ray_that_misses_the_box_is_harmless() -> None:
    rays = replace(rays_along_x(3), origins=torch.full((3, 3), 5.0))
    samples = ProposalSampler(BOX, (8, 8, 4)).sample(rays, Wall(0, 1), False)
    assert bool((samples.deltas == 0).all())
    assert bool(torch.isfinite(samples.t).all())


@pytest.mark.medium
@pytest.mark.parametrize("unbounded", [True, False])
def test_proposals_learn_where_the_wall_is(unbounded: bool) -> None:
    """Samples move into the wall, and so the depth found becomes exact."""
    torch.manual_seed(0)
    wall, rays = Wall(0.3, 0.5), rays_along_x(256)
    sampler = ProposalSampler(BOX, (48, 24, 12), unbounded=unbounded, log2_table_size=12, anneal_steps=20)
    optimizer = torch.optim.Adam(sampler.parameters(), lr=1e-2, eps=1e-15)

    def depth_error() -> float:
        with torch.no_grad():
            found = shown(wall, sampler.eval(), rays, 0.0, jitter=False).median_depth
        return (found - 1.2).abs().median().item()

    def share_inside() -> float:
        x = sampler.eval().sample(rays, wall, False).positions(rays)[:, 0]
        return ((x > 0.25) & (x < 0.55)).float().mean().item()

    before = share_inside()
    losses = []
    for step in range(150):
        sampler.train().update(step, wall.density)
        rendered = shown(wall, sampler, rays, 0.0, jitter=True)
        assert rendered.samples is not None
        assert rendered.weights is not None
        loss = interlevel_loss(rendered.samples, rendered.weights)
        losses.append(loss.item())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert losses[-1] < losses[5] / 3
    assert share_inside() > max(0.6, 2 * before)
    assert depth_error() < 0.02


def test_proposals_rest_in_most_steps_later() -> None:
    sampler, rays = ProposalSampler(BOX, (8, 8, 4)), rays_along_x(4)
    learning = []
    for step in range(1000, 1008):
        sampler.update(step, Wall(0, 1).density)
        learning.append(bool(sampler.sample(rays, Wall(0, 1), True).proposals))
    assert learning == [True, False, False, False] * 2
    with torch.no_grad():
        sampler.update(1000, Wall(0, 1).density)
        assert sampler.sample(rays, Wall(0, 1), False).proposals == ()


def test_annealing_is_the_papers() -> None:
    sampler = ProposalSampler(BOX, (8, 8, 4), anneal_steps=1000)
    for step, expected in ((0, 0.0), (100, 1 / 1.9), (1000, 1.0), (5000, 1.0)):
        sampler.update(step, Wall(0, 1).density)
        assert math.isclose(sampler.power.on(BOX.device), expected)


def test_light_that_no_wall_stops_ends_in_the_last_interval_of_an_unbounded_ray() -> None:
    """The sky is learnt as matter far away: any density there is opaque over an endless interval."""
    sampler = ProposalSampler(BOX, (16, 8, 4), unbounded=True, endless=True)
    rendered = shown(Wall(0.3, 1e9), sampler, rays_along_x(5), 1.0, jitter=False)
    torch.testing.assert_close(rendered.accumulation, torch.ones(5))
    torch.testing.assert_close(rendered.rgb, torch.full((5, 3), 0.5))


# -- other density fields than hash grids -----------------------------------------------------------------------------


class Asked(Wall):
    """A wall that records its calls, with a density to learn."""

    def __init__(self, footprint: str) -> None:
        super().__init__(0.3, 0.5)
        self.footprint = footprint  # type: ignore[misc, assignment]
        self.factor = torch.nn.Parameter(torch.ones(()))
        self.asked: list[Points] = []

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        self.asked.append(points)
        sigma, features = super().density(points)
        return self.factor * sigma, features


def cones_along_x(count: int) -> Rays:
    return replace(rays_along_x(count), pixel_radii=torch.full((count,), 0.01))


@pytest.mark.parametrize("footprint", ["none", "radius", "gaussian"])
def test_a_field_serves_all_levels_and_is_asked_about_the_size_it_needs(footprint: str) -> None:
    field = Asked(footprint)
    sampler = ProposalSampler(BOX, (24, 12, 8), unbounded=True, fields=[field])
    assert sampler.proposals == [field, field]
    assert [name for name, _ in sampler.named_parameters()] == ["fields.0.factor"]
    sampler.update(0, field.density)
    samples = sampler.sample(cones_along_x(5), Wall(0, 1), True)
    assert [len(points) for points in field.asked] == [5 * 24, 5 * 12]
    for points, histogram in zip(field.asked, samples.proposals, strict=True):
        assert (points.radii is None, points.variances is None) == (footprint == "none", footprint != "gaussian")
        assert points.positions.shape == (histogram.weights.numel(), 3)
        assert histogram.weights.requires_grad
    if footprint == "gaussian":  # the Gaussians of intervals that meet: lengths are sqrt(12) standard deviations
        first = field.asked[0]
        assert first.variances is not None
        lengths = (12 * first.variances[:, 0]).sqrt().view(5, 24)[:, 3:9]
        x = first.positions[:, 0].view(5, 24)[:, 3:9]
        torch.testing.assert_close((lengths[:, 1:] + lengths[:, :-1]) / 2, x.diff(dim=-1), rtol=0.1, atol=1e-3)


def test_the_gaussian_of_an_endless_interval_is_that_of_its_beginning() -> None:
    """The sky is learnt as matter at the far end of rays, and not at the mean of an interval of 10^10."""
    field = Asked("gaussian")
    sampler = ProposalSampler(BOX, (16, 8, 4), unbounded=True, endless=True, fields=[Wall(0.3, 1e9)])
    samples = sampler.sample(cones_along_x(5), field, False)
    (points,) = field.asked
    assert bool((samples.padded(samples.t_ends)[:, -1] == ENDLESS_FAR).all())
    assert float(points.positions.abs().max()) < 1001
    assert samples.sigma is not None
    assert samples.sigma.requires_grad
    plain = Asked("none")
    assert sampler.sample(cones_along_x(5), plain, False).sigma is None
    assert plain.asked == []


def test_how_often_proposals_learn_and_how_many_there_are() -> None:
    sampler = ProposalSampler(BOX, (8, 4), (64,), learn_every=1)
    for step in (300, 301, 302):
        sampler.update(step, Wall(0, 1).density)
        assert sampler.learning
    with pytest.raises(ValueError, match="2 density fields for 1 proposals"):
        ProposalSampler(BOX, (8, 4), fields=[Wall(0, 1), Wall(0, 1)])
    with pytest.raises(ValueError, match="give one more"):
        ProposalSampler(BOX, (8, 4))
