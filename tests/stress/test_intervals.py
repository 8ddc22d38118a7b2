"""Weights of intervals: densities and lengths from nothing to infinity, thin media, NaN, rays without samples."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.compositing.density import (
    MAX_OPTICAL_DEPTH,
    Composited,
    composite,
    optical_depth,
    weights_and_transmittance,
)
from nerfloom.kernels.histograms.intervals import interval_weights
from nerfloom.rendering.rendered import Rendered
from nerfloom.rendering.volume import volume_render
from tests.kernels.test_compositing import EXTREMES, ragged
from tests.stress.backends import FEW, backends

FINITE = EXTREMES[:-1]
INTERVAL = st.tuples(st.sampled_from(EXTREMES), st.sampled_from(EXTREMES))
"""Density and length of an interval."""
ENDING = st.tuples(st.sampled_from(EXTREMES), st.sampled_from(FINITE))
"""The same for an interval that others can follow along the same line."""
TABLES = st.tuples(st.integers(1, 6), st.integers(0, 4)).flatmap(
    lambda shape: st.tuples(
        st.just(shape[0]),
        st.lists(st.lists(ENDING, min_size=shape[0], max_size=shape[0]), min_size=shape[1], max_size=shape[1]),
    )
)
"""Maximum number of intervals of a ray, and the intervals of each ray."""
THIN = 4096
"""Samples in a thin medium."""

Ray = list[tuple[float, float]]


def by_hand(ray: Ray) -> tuple[list[float], list[float]]:
    """Weight of each interval in float64, and the light left in front of each and behind the last."""
    weights, left, depth = [], [1.0], 0.0
    for density, length in ray:
        tau = 0.0 if density == 0 or length == 0 else min(density * length, MAX_OPTICAL_DEPTH)
        weights.append(math.exp(-depth) * -math.expm1(-tau))
        depth += tau
        left.append(math.exp(-depth))
    return weights, left


def slopes_by_hand(ray: Ray, factors: list[float]) -> list[float]:
    """Derivative by each density of the weights' sum times `factors`; 0 where optical depth is cut off."""
    weights, left = by_hand(ray)
    found = []
    for i, (density, length) in enumerate(ray):
        behind = math.fsum(f * w for f, w in zip(factors[i + 1 :], weights[i + 1 :], strict=True))
        below = math.isfinite(density) and density * length <= MAX_OPTICAL_DEPTH
        found.append(length * (factors[i] * left[i + 1] - behind) if below else 0.0)
    return found


def some_factors(count: int) -> list[float]:
    """Factors of alternating sign and different sizes."""
    return [(-1.0) ** i * (i + 1) / 4 for i in range(count)]


def packed(rays: list[Ray]) -> tuple[Samples, Tensor]:
    """Samples that all start at 0, and their densities."""
    sigma, lengths = (torch.tensor([interval[i] for ray in rays for interval in ray]) for i in (0, 1))
    offsets = torch.tensor([0, *map(len, rays)]).cumsum(0)
    return Samples(torch.zeros_like(lengths), lengths, offsets), sigma


def composited(samples: Samples, sigma: Tensor) -> Composited:
    """Grey samples over white, rays of length 10."""
    rays = samples.num_rays
    return composite(samples, sigma, torch.full((len(sigma), 3), 0.25), torch.ones(rays, 3), torch.full((rays,), 10.0))


def weights_along(function: str, sigma: Tensor, edges: Tensor) -> Tensor:
    """Weights (B,) of one ray's intervals between edges (B + 1,)."""
    if function == "interval_weights":
        return interval_weights(sigma[None], edges[None])[0]
    per_ray = len(sigma) if function == "composite, padded" else None
    return composited(Samples(edges[:-1], edges[1:], torch.tensor([0, len(sigma)]), per_ray=per_ray), sigma).weights


each_function = pytest.mark.parametrize("function", ["composite", "composite, padded", "interval_weights"])


# -- densities and lengths ----------------------------------------------------------------------------------------


@pytest.mark.entry(8)
@backends()
@FEW
@given(rays=st.lists(st.lists(INTERVAL, max_size=6), max_size=4))
def test_extreme_densities_and_lengths(backend: str, rays: list[Ray]) -> None:
    """Optical depth is cut off, and never NaN; rays without intervals show the background."""
    samples, sigma = packed(rays)
    found = composited(samples, sigma)
    ends = samples.offsets.tolist()
    for index, ray in enumerate(rays):
        weights, _ = by_hand(ray)
        total = math.fsum(weights)
        assert found.weights[ends[index] : ends[index + 1]].tolist() == pytest.approx(weights, rel=1e-4, abs=1e-37)
        assert found.opacity[index].item() == pytest.approx(total, rel=1e-4, abs=1e-37)
        assert found.color[index].tolist() == pytest.approx([1 - 0.75 * total] * 3, abs=1e-4)


@pytest.mark.entry(8)
@backends()
@FEW
@given(ray=st.lists(INTERVAL, max_size=6))
def test_slopes_of_extreme_densities_and_lengths(backend: str, ray: Ray) -> None:
    """Slopes are proportional to the length; an interval without end has none."""
    samples, sigma = packed([ray])
    factors = some_factors(len(ray))
    weights = composited(samples, sigma.requires_grad_()).weights
    (slopes,) = torch.autograd.grad((weights * torch.tensor(factors)).sum(), sigma)
    for (_, length), slope, truth in zip(ray, slopes.tolist(), slopes_by_hand(ray, factors), strict=True):
        rounding = 1e-4 * length if math.isfinite(length) else 0.0
        assert slope == pytest.approx(truth, rel=0, abs=rounding + 1e-37)


@pytest.mark.entry(8)
@backends()
@FEW
@given(table=TABLES)
def test_extreme_histograms(backend: str, table: tuple[int, list[Ray]]) -> None:
    """The same holds for weights between edges: short intervals behind long ones then have no length."""
    bins, rays = table
    lengths = torch.tensor([[length for _, length in ray] for ray in rays]).view(len(rays), bins)
    sigma = torch.tensor([[density for density, _ in ray] for ray in rays]).view(len(rays), bins).requires_grad_()
    edges = torch.cat([torch.zeros(len(rays), 1), lengths.cumsum(-1)], dim=-1)
    factors = some_factors(bins)
    weights = interval_weights(sigma, edges)
    (slopes,) = torch.autograd.grad((weights * torch.tensor(factors)).sum(), sigma)
    rounded = [list(zip(s, d, strict=True)) for s, d in zip(sigma.tolist(), edges.diff(dim=-1).tolist(), strict=True)]
    for ray, found, found_slopes in zip(rounded, weights.tolist(), slopes.tolist(), strict=True):
        assert found == pytest.approx(by_hand(ray)[0], rel=1e-4, abs=1e-37)
        for (_, length), slope, truth in zip(ray, found_slopes, slopes_by_hand(ray, factors), strict=True):
            assert slope == pytest.approx(truth, rel=0, abs=1e-4 * length + 1e-37)


@pytest.mark.entry(8)
@backends()
@each_function
def test_empty_space_without_end_has_no_weight(backend: str, function: str) -> None:
    weights = weights_along(function, torch.tensor([1.0, 0.0]), torch.tensor([0.0, 1.0, math.inf]))
    assert weights.tolist() == pytest.approx([-math.expm1(-1), 0.0], rel=1e-5)


@pytest.mark.entry(8)
@backends()
@each_function
def test_empty_space_without_end_learns_nothing(backend: str, function: str) -> None:
    """Its slope would be infinite; samples in front learn as if nothing followed."""
    sigma = torch.tensor([1.0, 0.0], requires_grad=True)
    weights = weights_along(function, sigma, torch.tensor([0.0, 1.0, math.inf]))
    (slopes,) = torch.autograd.grad(weights.sum(), sigma)
    assert slopes.tolist() == pytest.approx([math.exp(-1), 0.0], rel=1e-5)


@pytest.mark.entry(8)
@backends()
def test_empty_space_without_end_leaves_the_depth_alone(backend: str) -> None:
    """Its middle is infinitely far away, and must have no part in the mean."""
    samples = Samples(torch.tensor([0.0, 1.0]), torch.tensor([1.0, math.inf]), torch.tensor([0, 2]))
    found = composited(samples, torch.tensor([1.0, 0.0]))
    assert found.moment.item() == pytest.approx(-math.expm1(-1) / 2, rel=1e-5)
    assert found.median.item() == 0.5


@pytest.mark.entry(8)
@backends()
@each_function
@pytest.mark.parametrize("density", EXTREMES[1:])
def test_matter_without_end_takes_what_is_left(backend: str, function: str, density: float) -> None:
    """However thin it is."""
    sigma = torch.tensor([0.5, density], requires_grad=True)
    weights = weights_along(function, sigma, torch.tensor([0.0, 1.0, math.inf]))
    (slopes,) = torch.autograd.grad(weights[1], sigma)
    assert weights.tolist() == pytest.approx([-math.expm1(-0.5), math.exp(-0.5)], rel=1e-5)
    assert slopes.tolist() == pytest.approx([-math.exp(-0.5), 0.0], rel=1e-5)


@pytest.mark.entry(8, 1)
def test_optical_depth_in_half_precision_is_cut_off_too() -> None:
    sigma = torch.tensor([0.0, 65504.0, math.inf, math.inf], dtype=torch.float16)
    found = optical_depth(sigma, torch.tensor([2.0, 65504.0, 0.0, 1.0], dtype=torch.float16))
    assert found.tolist() == [0.0, MAX_OPTICAL_DEPTH, 0.0, MAX_OPTICAL_DEPTH]


@pytest.mark.entry(1)
@backends()
@FEW
@given(
    counts=st.lists(st.integers(0, 4), max_size=4),
    dtype=st.sampled_from([torch.float16, torch.bfloat16, torch.float32]),
    stride=st.integers(1, 3),
)
def test_half_precision_is_composited_in_single(
    backend: str, counts: list[int], dtype: torch.dtype, stride: int
) -> None:
    """Densities and colours of any float type, contiguous or not, give the same as their values in float32."""
    samples, _ = packed([[(1.0, 0.5)] * count for count in counts])
    torch.manual_seed(0)
    sigma = (torch.rand(len(samples) * stride) * 6).to(dtype)[::stride]
    rgb = torch.rand(len(samples), 3 * stride).to(dtype)[:, ::stride]
    rays, background = straight([10.0] * len(counts)), torch.tensor([0.1, 0.2, 0.3])
    found = volume_render(rays, samples, sigma, rgb, background)
    truth = volume_render(rays, samples, sigma.float().contiguous(), rgb.float().contiguous(), background)
    assert found.rgb.dtype == found.accumulation.dtype == torch.float32
    assert torch.equal(found.rgb, truth.rgb)
    assert torch.equal(found.depth, truth.depth)


# -- thin media ---------------------------------------------------------------------------------------------------


@pytest.mark.entry(11)
@backends()
@each_function
def test_thin_samples_add_up_and_each_gets_its_gradient(backend: str, function: str) -> None:
    """4,096 samples of optical depth 1e-8 stop 4.1e-5 of the light: 1 - exp(-x) would be 0 for each."""
    sigma = torch.full((THIN,), 1e-8, requires_grad=True)
    weights = weights_along(function, sigma, torch.arange(THIN + 1.0))
    (slopes,) = torch.autograd.grad(weights.sum(), sigma)
    total = -math.expm1(-THIN * 1e-8)
    found = weights.double().sum().item()
    print(f"{backend} {function}: {THIN} thin samples stop {found:.6e}, exact {total:.6e}")
    assert found == pytest.approx(total, rel=1e-4)
    torch.testing.assert_close(slopes, torch.full((THIN,), 1 - total), rtol=1e-5, atol=0)


@pytest.mark.entry(11)
@backends()
@FEW
@given(count=st.integers(0, 1024), exponent=st.integers(-12, -3))
def test_thin_media_of_any_length(backend: str, count: int, exponent: int) -> None:
    """The sum is taken in float32, one sample after another, which needs the tolerance."""
    tau = 10.0**exponent
    samples = Samples(torch.zeros(count), torch.ones(count), torch.tensor([0, count]))
    opacity = composited(samples, torch.full((count,), tau)).opacity.item()
    assert opacity == pytest.approx(-math.expm1(-count * tau), rel=1e-3, abs=0)


@pytest.mark.entry(11)
@backends()
@each_function
def test_empty_samples_keep_all_of_the_light(backend: str, function: str) -> None:
    """A sample behind 4,096 empty samples has the same weight as alone."""
    sigma = torch.cat([torch.zeros(THIN), torch.tensor([0.7])])
    weights = weights_along(function, sigma, torch.arange(THIN + 2.0))
    alone = weights_along(function, sigma[-1:], torch.tensor([0.0, 1.0]))
    assert not weights[:-1].any()
    torch.testing.assert_close(weights[-1:], alone, rtol=2e-7, atol=0)
    assert alone.item() == pytest.approx(-math.expm1(-0.7), rel=1e-6)


@pytest.mark.entry(11)
@pytest.mark.parametrize("per_ray", [None, THIN])
def test_transmittance_behind_empty_samples_is_one(per_ray: int | None) -> None:
    edges = torch.linspace(0.0, 3.0, THIN + 1)
    samples = Samples(edges[:-1], edges[1:], torch.tensor([0, THIN]), per_ray=per_ray)
    sigma = torch.zeros(THIN)
    sigma[-1] = 5.0
    _, transmittance = weights_and_transmittance(sigma, samples)
    assert torch.equal(transmittance, torch.ones(THIN))


@pytest.mark.entry(11)
@backends()
@pytest.mark.parametrize("function", ["composite, padded", "interval_weights"])
def test_a_wall_behind_a_thin_medium_gets_what_that_leaves(backend: str, function: str) -> None:
    sigma = torch.cat([torch.full((THIN,), 1e-8), torch.tensor([1e30])])
    weights = weights_along(function, sigma, torch.arange(THIN + 2.0))
    assert weights[-1].item() == pytest.approx(math.exp(-THIN * 1e-8), rel=1e-5)


# -- sums that run over many samples and rays ---------------------------------------------------------------------


@pytest.mark.entry(3)
@backends()
def test_a_hundred_thousand_opaque_samples_leave_the_last_ray_alone(backend: str) -> None:
    count, each = 100_000, 100
    sigma = torch.full((count,), 1e30)
    sigma[-each:] = 1e-5
    samples = Samples(torch.zeros(count), torch.ones(count), torch.arange(0, count + 1, each))
    found = composited(samples, sigma).weights[-each:]
    weights, _ = by_hand([(1e-5, 1.0)] * each)
    assert found.tolist() == pytest.approx(weights, rel=1e-5)


@pytest.mark.entry(3)
@backends()
def test_an_empty_sample_before_a_wall_learns_whatever_rays_came_before(backend: str) -> None:
    """More density in front takes from the wall, also where the sum of the ray before has odd digits at its end."""
    odd = 2637 * 2.0**-43
    sigma = torch.tensor([1000.0, odd, 0.0, 1000.0], requires_grad=True)
    samples = Samples(torch.zeros(4), torch.ones(4), torch.tensor([0, 2, 4]))
    (slopes,) = torch.autograd.grad(composited(samples, sigma).weights[3], sigma)
    assert slopes[2].item() == pytest.approx(-1.0)


# -- NaN ----------------------------------------------------------------------------------------------------------


@pytest.mark.entry(12)
@backends()
@each_function
@FEW
@given(before=st.integers(0, 4), behind=st.integers(0, 4), length=st.sampled_from(FINITE))
def test_nan_density_is_seen(backend: str, function: str, before: int, behind: int, length: float) -> None:
    """It is in its own weight, however short the interval, and in all behind it; samples in front are not touched."""
    sigma = torch.tensor([1.0] * before + [math.nan] + [1.0] * behind)
    edges = torch.tensor([0.0] + [1.0] * before + [length] + [1.0] * behind).cumsum(0)
    weights = weights_along(function, sigma, edges)
    assert bool(weights[before:].isnan().all())
    assert weights[:before].tolist() == pytest.approx(by_hand([(1.0, 1.0)] * before)[0], rel=1e-5)


@pytest.mark.entry(12)
@backends()
def test_nan_density_is_seen_in_the_picture_and_the_gradient(backend: str) -> None:
    samples, sigma = packed([[(1.0, 1.0), (math.nan, 1.0), (1.0, 1.0)]])
    sigma.requires_grad_()
    out = volume_render(straight([9.0]), samples, sigma, torch.rand(3, 3), torch.ones(3))
    out.rgb.sum().backward()
    assert bool(out.rgb.isnan().all())
    assert bool(out.accumulation.isnan().all())
    assert sigma.grad is not None
    assert not bool(sigma.grad.isfinite().all())


@pytest.mark.entry(12)
@backends()
def test_a_nan_ray_leaves_the_next_ones_alone(backend: str) -> None:
    samples, sigma = packed([[(math.nan, 1.0), (1.0, 1.0)], [(1.0, 1.0), (2.0, 1.0)]])
    found = composited(samples, sigma)
    assert bool(found.weights[:2].isnan().all())
    assert found.weights[2:].tolist() == pytest.approx(by_hand([(1.0, 1.0), (2.0, 1.0)])[0], rel=1e-5)


# -- rays without samples, and chunks -----------------------------------------------------------------------------


def straight(fars: list[float]) -> Rays:
    """Rays along x from the origin."""
    count = len(fars)
    return Rays(torch.zeros(count, 3), torch.eye(3)[:1].expand(count, 3), torch.zeros(count), torch.tensor(fars))


@pytest.mark.entry(4)
@backends()
@pytest.mark.parametrize("counts", [[], [0], [0, 0, 0], [0, 2, 0, 0, 1]])
def test_rays_without_samples_show_the_background(backend: str, counts: list[int]) -> None:
    samples, sigma = packed([[(1.0, 0.5)] * count for count in counts])
    rgb = torch.full((len(samples), 3), 0.25, requires_grad=True)
    rays, background = straight([7.0 + index for index in range(len(counts))]), torch.tensor([0.1, 0.2, 0.3])
    out = volume_render(rays, samples, sigma.requires_grad_(), rgb, background)
    empty = torch.tensor(counts, dtype=torch.int64) == 0
    assert torch.equal(out.rgb[empty], background.expand(int(empty.sum()), 3))
    assert torch.equal(out.depth[empty], rays.fars[empty])
    assert torch.equal(out.median_depth[empty], rays.fars[empty])
    assert not out.accumulation[empty].any()
    assert bool((out.accumulation[~empty] > 0.3).all())
    out.rgb.sum().backward()
    for values in (sigma, rgb):
        assert values.grad is not None
        assert values.grad.shape == values.shape
        assert bool((values.grad != 0).all())


@pytest.mark.entry(23)
@backends()
@pytest.mark.parametrize("chunk", [1, 3])
def test_depth_does_not_depend_on_the_chunk(backend: str, chunk: int) -> None:
    counts = [0, 5, 1, 0, 40, 7, 0, 3]
    samples, sigma = ragged(counts)
    rays = straight([100.0 + index for index in range(len(counts))])

    def render(first: int, last: int) -> Rendered:
        start, end = samples.offsets[first].item(), samples.offsets[last].item()
        starts, ends = (t[start:end].float() for t in (samples.t_starts, samples.t_ends))
        part = Samples(starts, ends, samples.offsets[first : last + 1] - start)
        rgb = torch.full((len(part), 3), 0.5)
        return volume_render(rays[first:last], part, sigma[start:end].float(), rgb, torch.zeros(3))

    whole = render(0, len(counts))
    parts = [render(first, min(first + chunk, len(counts))) for first in range(0, len(counts), chunk)]
    for name in ("depth", "median_depth", "accumulation"):
        together = torch.cat([getattr(part, name) for part in parts])
        torch.testing.assert_close(together, getattr(whole, name), rtol=1e-6, atol=1e-6)
    ends, middles = samples.offsets.tolist(), samples.t.tolist()
    for index, far in enumerate(rays.fars.tolist()):
        own = slice(ends[index], ends[index + 1])
        weights, _ = by_hand(list(zip(sigma[own].tolist(), samples.deltas[own].tolist(), strict=True)))
        moment = math.fsum(w * t for w, t in zip(weights, middles[own], strict=True))
        truth = moment / math.fsum(weights) if weights else far
        assert whole.depth[index].item() == pytest.approx(truth, rel=1e-5)
