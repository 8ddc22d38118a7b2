"""Coarse-to-fine samples: stratified ones, and more where a coarse field finds something with them."""

import pytest
import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.fields.base import Field
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import CoarseLevel, Rays, Samples
from nerfloom.methods.vanilla_nerf import VanillaNeRFConfig
from nerfloom.rendering.volume import VolumeRenderer
from nerfloom.samplers.hierarchical import HierarchicalSampler, blurred
from nerfloom.samplers.uniform import LAST_INTERVAL, stratified_points

COARSE, FINE = 16, 48


class Slab(Field):
    """Density between two planes across x, a parameter; it records its calls."""

    def __init__(self, low: float, high: float, sigma: float) -> None:
        super().__init__()
        self.low, self.high = low, high
        self.sigma = torch.nn.Parameter(torch.tensor(sigma))
        self.asked: list[Points] = []

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        self.asked.append(points)
        x = points.positions[:, 0]
        return self.sigma * ((x > self.low) & (x < self.high)), points.positions

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        return torch.full_like(features, 0.25)


class Unasked(Field):
    """The fine field, which the sampler leaves to the renderer."""

    def density(self, points: Points) -> tuple[Tensor, Tensor]:
        raise AssertionError

    def color(self, features: Tensor, directions: Tensor, camera_indices: Tensor | None = None) -> Tensor:
        raise AssertionError


def rays_along_x(count: int, times: Tensor | None = None) -> Rays:
    """Rays from x = 0 to 8 with bins of half a unit, so that x is t."""
    torch.manual_seed(0)
    origins = torch.cat([torch.zeros(count, 1), torch.rand(count, 2)], dim=-1)
    directions = torch.eye(3)[:1].expand(count, 3)
    return Rays(origins, directions, torch.zeros(count), torch.full((count,), 8.0), torch.full((count,), 0.01), times)


def coarse_of(samples: Samples) -> CoarseLevel:
    assert samples.coarse is not None
    return samples.coarse


def drawn_of(samples: Samples) -> Tensor:
    """The samples (R, FINE) that are not the coarse level's."""
    t, stratified = samples.padded(samples.t), coarse_of(samples).samples
    both = torch.cat([stratified.padded(stratified.t), t], dim=-1).sort(dim=-1).values
    repeated = both[:, 1:] == both[:, :-1]
    assert bool((repeated.sum(-1) == COARSE).all())  # each stratified one is among them, once
    single = ~(torch.nn.functional.pad(repeated, (1, 0)) | torch.nn.functional.pad(repeated, (0, 1)))
    return both[single].view(len(t), FINE)


@pytest.mark.parametrize("jitter", [True, False])
@pytest.mark.parametrize("count", [0, 7])
def test_samples_are_the_stratified_and_the_drawn_ones_sorted(count: int, jitter: bool) -> None:
    """They are points of NeRF's quadrature: the interval of each ends at the next, the last one nowhere."""
    sampler = HierarchicalSampler(Slab(2.0, 3.0, 5.0), COARSE, FINE)
    rays = rays_along_x(count)
    torch.manual_seed(3)
    samples = sampler.sample(rays, Unasked(), jitter)
    assert samples.per_ray == COARSE + FINE
    assert samples.num_rays == count
    assert (samples.sigma, samples.features) == (None, None)
    t, ends = (samples.padded(values) for values in (samples.t, samples.t_ends))
    assert bool((t.diff(dim=-1) >= 0).all())
    torch.testing.assert_close(samples.padded(samples.t_starts), t)
    torch.testing.assert_close(ends[:, :-1], t[:, 1:])
    assert bool((ends[:, -1] >= LAST_INTERVAL).all())
    torch.manual_seed(3)
    stratified = stratified_points(rays, COARSE, jitter)
    level = coarse_of(samples)
    torch.testing.assert_close(level.samples.padded(level.samples.t), stratified, rtol=0, atol=0)
    assert drawn_of(samples).shape == (count, FINE)


@pytest.mark.parametrize("jitter", [True, False])
def test_samples_are_drawn_where_the_coarse_field_is_dense(jitter: bool) -> None:
    """Between the middles of the stratified samples around the only one that finds something."""
    samples = HierarchicalSampler(Slab(4.0, 4.5, 1e3), COARSE, FINE).sample(rays_along_x(20), Unasked(), jitter)
    drawn = drawn_of(samples)
    stratified = coarse_of(samples).samples.padded(coarse_of(samples).samples.t)
    low, high = ((stratified[:, [i]] + stratified[:, [i + 1]]) / 2 for i in (7, 8))
    assert ((drawn >= low) & (drawn <= high)).float().mean().item() > 0.99


def test_samples_are_drawn_by_the_weights_of_the_stratified_ones() -> None:
    """Fewer are behind half-transparent matter: by hand, every half unit from t = 1.25, by the intervals' weights."""
    samples = HierarchicalSampler(Slab(1.0, 3.0, 1.2), COARSE, 4096).sample(rays_along_x(1), Unasked(), False)
    t = samples.t
    stop = 1 - torch.exp(torch.tensor(-1.2 * 0.5)).item()
    shares = [stop * (1 - stop) ** index for index in range(4)]
    for index, share in enumerate(shares):
        middle = 1.25 + 0.5 * index
        inside = (t > middle - 0.25) & (t < middle + 0.25) & (t != middle)
        assert inside.sum().item() / 4096 == pytest.approx(share / sum(shares), abs=2e-3)


@pytest.mark.parametrize("jitter", [True, False])
def test_where_nothing_is_found_samples_are_drawn_evenly(jitter: bool) -> None:
    samples = HierarchicalSampler(Slab(9.0, 9.5, 1.0), COARSE, FINE).sample(rays_along_x(400), Unasked(), jitter)
    drawn, stratified = drawn_of(samples), coarse_of(samples).samples
    middles = stratified.padded(stratified.t)
    first, last = (middles[:, :2].mean(-1, keepdim=True), middles[:, -2:].mean(-1, keepdim=True))
    share = (drawn - first) / (last - first)
    assert bool(((share >= -1e-5) & (share <= 1 + 1e-5)).all())
    for quantile in (0.1, 0.5, 0.9):
        assert (share < quantile).float().mean().item() == pytest.approx(quantile, abs=0.02)


def test_the_coarse_field_is_asked_once_for_all_that_it_is_shown_by() -> None:
    """It gets times and its footprint; density has a gradient, and the positions drawn by it have none."""
    coarse = Slab(2.0, 3.0, 5.0)
    coarse.footprint = "radius"  # type: ignore[misc]
    rays = rays_along_x(3, times=torch.tensor([0.1, 0.2, 0.3]))
    samples = HierarchicalSampler(coarse, COARSE, FINE).sample(rays, Unasked(), True)
    (points,) = coarse.asked
    level = coarse_of(samples)
    assert level.field is coarse
    torch.testing.assert_close(points.positions, level.samples.positions(rays))
    assert points.times is not None
    assert points.times.tolist() == pytest.approx([0.1] * COARSE + [0.2] * COARSE + [0.3] * COARSE)
    torch.testing.assert_close(points.radii, 0.01 * level.samples.t)
    assert level.samples.sigma is not None
    assert level.samples.sigma.requires_grad
    assert not samples.t.requires_grad


def test_evaluation_is_repeatable_and_training_is_not() -> None:
    sampler, rays = HierarchicalSampler(Slab(2.0, 3.0, 5.0), COARSE, FINE), rays_along_x(5)
    fixed = [sampler.sample(rays, Unasked(), False).t for _ in range(2)]
    drawn = [sampler.sample(rays, Unasked(), True).t for _ in range(2)]
    assert torch.equal(*fixed)
    assert bool((drawn[0] != drawn[1]).all())


def test_both_levels_are_rendered_and_their_evaluations_counted() -> None:
    """A slab that only the coarse field has is seen in the coarse picture alone, and the other way round."""
    fine, coarse = Slab(6.0, 7.0, 1e3), Slab(2.0, 3.0, 1e3)
    rays = rays_along_x(4)
    rendered = VolumeRenderer().render(
        rays, HierarchicalSampler(coarse, COARSE, FINE).sample(rays, fine, False), fine, torch.ones(3)
    )
    assert rendered.coarse is not None
    assert rendered.num_samples == 4 * (COARSE + COARSE + FINE)
    for level, depth in ((rendered, 6.25), (rendered.coarse, 2.25)):
        torch.testing.assert_close(level.rgb, torch.full((4, 3), 0.25), rtol=0, atol=1e-3)
        torch.testing.assert_close(level.depth, torch.full((4,), depth), rtol=0, atol=0.02)
    (rendered.rgb.sum() + rendered.coarse.rgb.sum()).backward()
    assert fine.sigma.grad is not None
    assert coarse.sigma.grad is not None


def test_three_stratified_samples_are_enough_and_fewer_are_refused() -> None:
    samples = HierarchicalSampler(Slab(2.0, 3.0, 5.0), 3, 4).sample(rays_along_x(2), Unasked(), False)
    t = samples.padded(samples.t)
    assert t.shape == (2, 7)
    assert bool((t.diff(dim=-1) >= 0).all())
    assert bool(((t >= 0) & (t <= 8)).all())
    with pytest.raises(ValueError, match="2 stratified samples are too few"):
        HierarchicalSampler(Slab(2.0, 3.0, 5.0), 2, 4)
    with pytest.raises(ConfigError, match="--num-coarse-samples"):
        VanillaNeRFConfig(num_coarse_samples=2)


# -- the field as its own coarse level, in intervals ------------------------------------------------------------------


@pytest.mark.parametrize("jitter", [True, False])
@pytest.mark.parametrize("count", [0, 7])
def test_intervals_divide_the_ray_and_the_field_is_its_own_coarse_level(count: int, jitter: bool) -> None:
    field = Slab(2.0, 3.0, 5.0)
    field.footprint = "gaussian"  # type: ignore[misc]
    rays = rays_along_x(count, times=torch.full((count,), 0.5))
    samples = HierarchicalSampler(None, COARSE, FINE).sample(rays, field, jitter)
    level = coarse_of(samples)
    assert level.field is field
    assert (len(level.samples), len(samples)) == (count * COARSE, count * FINE)
    for found in (level.samples, samples):
        starts, ends = found.padded(found.t_starts), found.padded(found.t_ends)
        torch.testing.assert_close(starts[:, 1:], ends[:, :-1], rtol=0, atol=0)
        assert bool((ends >= starts).all())
        assert bool(((starts >= 0) & (ends <= 8)).all())
    assert bool((level.samples.padded(level.samples.t_starts)[:, :1] == 0).all())
    assert bool((level.samples.padded(level.samples.t_ends)[:, -1:] == 8).all())
    (points,) = field.asked
    assert points.variances is not None
    assert points.times is not None
    assert bool(
        ((points.positions[:, 0] > level.samples.t_starts) & (points.positions[:, 0] < level.samples.t_ends)).all()
    )
    assert level.samples.sigma is not None
    assert level.samples.sigma.requires_grad
    assert not samples.t.requires_grad


def test_intervals_are_drawn_by_blurred_weights() -> None:
    """By hand, a wall is in the bin [4, 4.5]; half of its weight is on each neighbour, and 0.01 in every bin."""
    samples = HierarchicalSampler(None, COARSE, 4095).sample(rays_along_x(1), Slab(4.0, 4.5, 1e3), False)
    expected = torch.full((COARSE,), 0.01)
    expected[7:10] += torch.tensor([0.5, 1.0, 0.5])
    edges = torch.cat([samples.t_starts, samples.t_ends[-1:]])
    shares = torch.histogram(edges, COARSE, range=(0.0, 8.0)).hist / len(edges)
    torch.testing.assert_close(shares, expected / expected.sum(), atol=1e-3, rtol=0)


def test_the_blur_is_a_maximum_and_then_a_mean() -> None:
    weights = torch.rand(20, 9, dtype=torch.float64)
    padded = torch.nn.functional.pad(weights, (1, 1), mode="replicate")
    truth = torch.tensor(
        [[(max(row[i], row[i + 1]) + max(row[i + 1], row[i + 2])) / 2 for i in range(9)] for row in padded.tolist()],
        dtype=torch.float64,
    )
    torch.testing.assert_close(blurred(weights), truth)
    assert bool((blurred(weights) >= weights).all())
