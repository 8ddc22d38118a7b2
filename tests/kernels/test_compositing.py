"""Compositing and volume rendering against closed forms, in float64."""

import math

import pytest
import torch
from scipy.special import erf

from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.compositing.density import exclusive_sum, optical_depth, ray_sum, weights_and_transmittance
from nerfloom.rendering.volume import volume_render

F64 = torch.float64


def intervals(edges: torch.Tensor, num_rays: int = 1) -> Samples:
    """The same intervals on each ray."""
    edges = edges.expand(num_rays, -1)
    return Samples.regular(edges[:, :-1], edges[:, 1:])


def rays_along_x(num_rays: int, far: float = 10.0) -> Rays:
    zero = torch.zeros(num_rays, 3, dtype=F64)
    one = torch.tensor([1.0, 0, 0], dtype=F64).expand(num_rays, 3)
    return Rays(zero, one, torch.zeros(num_rays, dtype=F64), torch.full((num_rays,), far, dtype=F64))


def ragged(counts: list[int], seed: int = 0) -> tuple[Samples, torch.Tensor]:
    """Packed samples with the given number on each ray, and densities."""
    generator = torch.Generator().manual_seed(seed)
    edges = [torch.rand(n + 1, generator=generator, dtype=F64).cumsum(0) for n in counts]
    starts = torch.cat([e[:-1] if n else e[:0] for e, n in zip(edges, counts, strict=True)])
    ends = torch.cat([e[1:] if n else e[:0] for e, n in zip(edges, counts, strict=True)])
    offsets = torch.tensor([0, *counts]).cumsum(0)
    return Samples(starts, ends, offsets), torch.rand(len(starts), generator=generator, dtype=F64) * 3


@pytest.mark.parametrize("sigma", [1e-6, 0.3, 5.0, 200.0])
def test_constant_density(sigma: float) -> None:
    samples = intervals(torch.linspace(0, 4, 65, dtype=F64))
    densities = torch.full((64,), sigma, dtype=F64)
    out = volume_render(rays_along_x(1), samples, densities, torch.full((64, 3), 0.7, dtype=F64), torch.zeros(3))
    opacity = -math.expm1(-4 * sigma)
    error = abs(out.accumulation.item() - opacity)
    print(f"constant density {sigma:g}: opacity off by {error:.2e}")
    assert error < 1e-13
    torch.testing.assert_close(out.rgb, torch.full((1, 3), 0.7 * opacity, dtype=F64), rtol=1e-12, atol=0)


def test_slab() -> None:
    """Density 2.5 between t = 1 and t = 2.5, a background of 0.2 behind."""
    edges = torch.linspace(0, 4, 41, dtype=F64)
    samples = intervals(edges)
    inside = (samples.t > 1) & (samples.t < 2.5)
    color = torch.tensor([1.0, 0.5, 0.0], dtype=F64).expand(40, 3)
    background = torch.full((3,), 0.2, dtype=F64)
    out = volume_render(rays_along_x(1), samples, inside * torch.tensor(2.5, dtype=F64), color, background)
    through = math.exp(-2.5 * 1.5)
    expected = torch.tensor([1.0, 0.5, 0.0], dtype=F64) * (1 - through) + 0.2 * through
    error = (out.rgb[0] - expected).abs().max().item()
    print(f"slab: colour off by {error:.2e}")
    assert error < 1e-14
    # Half of the light is gone at t = 1 + ln 2 / 2.5; the answer is the middle of that interval of 0.1.
    assert abs(out.median_depth.item() - (1 + math.log(2) / 2.5)) <= 0.05 + 1e-9
    # Mean depth of an exponential cut at 1.5, up to the interval's width.
    mean = 1 + 1 / 2.5 - 1.5 * through / (1 - through)
    assert abs(out.depth.item() - mean) < 0.1**2


def test_gaussian_density_converges_with_the_square_of_the_step() -> None:
    """Optical depth of a Gaussian is an error function; colour = t, so depth is tested through colour too."""

    def opacity(count: int) -> float:
        samples = intervals(torch.linspace(0, 6, count + 1, dtype=F64))
        sigma = 1.7 * torch.exp(-((samples.t - 2.8) ** 2) / (2 * 0.6**2))
        weights, _ = weights_and_transmittance(sigma, samples)
        return weights.sum().item()

    def truth() -> float:
        def tau(t: float) -> float:
            return 1.7 * 0.6 * math.sqrt(math.pi / 2) * float(erf((t - 2.8) / (0.6 * math.sqrt(2))))

        return -math.expm1(-(tau(6.0) - tau(0.0)))

    # The Gaussian's tails at the ends are small but not zero, so the midpoint rule's order shows.
    errors = [abs(opacity(count) - truth()) for count in (8, 16, 32)]
    print("gaussian density, 8, 16 and 32 intervals: opacity off by " + ", ".join(f"{e:.2e}" for e in errors))
    assert errors[1] < errors[0] / 3
    assert errors[2] < errors[1] / 3


def test_packed_equals_one_ray_at_a_time() -> None:
    counts = [3, 0, 17, 1, 0, 64]
    samples, sigma = ragged(counts)
    weights, transmittance = weights_and_transmittance(sigma, samples)
    for ray, count in enumerate(counts):
        own = slice(int(samples.offsets[ray]), int(samples.offsets[ray + 1]))
        optical, expected = 0.0, []
        for s, d in zip(sigma[own].tolist(), samples.deltas[own].tolist(), strict=True):
            expected.append((math.exp(-optical) * -math.expm1(-s * d), math.exp(-optical)))
            optical += s * d
        for (w, t), got_w, got_t in zip(expected, weights[own].tolist(), transmittance[own].tolist(), strict=True):
            assert got_w == pytest.approx(w, rel=1e-11, abs=1e-15)
            assert got_t == pytest.approx(t, rel=1e-11)
        assert ray_sum(weights, samples)[ray].item() == pytest.approx(sum(w for w, _ in expected), rel=1e-11, abs=0)
        assert count == len(expected)


def test_thin_samples_are_not_lost_in_float32() -> None:
    """4,096 samples of optical depth 1e-8: 1 - exp(-x) would be zero for each."""
    samples = intervals(torch.linspace(0, 1, 4097))
    weights, _ = weights_and_transmittance(torch.full((4096,), 1e-8 * 4096), samples)
    total = weights.sum().item()
    print(f"4,096 thin samples: opacity {total:.6e}, exact {-math.expm1(-4096e-8):.6e}")
    assert total == pytest.approx(-math.expm1(-4096e-8), rel=1e-4)


def test_one_opaque_ray_does_not_disturb_its_neighbours() -> None:
    """Packed samples of all rays stand in one row: a wall in one must not cost the next one's precision."""
    samples = Samples(torch.arange(6.0), torch.arange(6.0) + 1, torch.tensor([0, 3, 6]))
    sigma = torch.tensor([1e30, 1e30, 1e30, 1e-4, 1e-4, 1e-4])
    before = exclusive_sum(optical_depth(sigma, samples.deltas), samples)
    torch.testing.assert_close(before[3:], torch.tensor([0.0, 1e-4, 2e-4]), rtol=1e-5, atol=0)


EXTREMES = [0.0, 1e-30, 1e-10, 1.0, 1e10, 1e30, math.inf]


@pytest.mark.parametrize("per_ray", [None, len(EXTREMES)])
def test_extreme_densities_and_lengths(per_ray: int | None) -> None:
    lengths = torch.tensor(EXTREMES[:-1])
    sigma = torch.tensor(EXTREMES).repeat(len(lengths)).requires_grad_()
    starts = torch.zeros(len(sigma))
    offsets = torch.arange(len(lengths) + 1) * len(EXTREMES)
    samples = Samples(starts, lengths.repeat_interleave(len(EXTREMES)), offsets, per_ray=per_ray)
    weights, transmittance = weights_and_transmittance(sigma, samples)
    assert bool(((weights >= 0) & (weights <= 1)).all())
    assert bool(((transmittance >= 0) & (transmittance <= 1)).all())
    assert bool((ray_sum(weights, samples) <= 1 + 1e-6).all())
    weights.sum().backward()
    assert sigma.grad is not None
    assert bool(torch.isfinite(sigma.grad).all())
    assert weights[: len(EXTREMES)].sum().item() == 0  # no length, no weight, at any density


def test_nan_density_is_seen() -> None:
    weights, _ = weights_and_transmittance(torch.tensor([1.0, math.nan, 1.0]), intervals(torch.arange(4.0)))
    assert bool(weights.isnan().any())


@pytest.mark.parametrize("num_rays", [0, 3])
def test_no_samples_give_the_background(num_rays: int) -> None:
    none = torch.zeros(0, dtype=F64)
    samples = Samples(none, none, torch.zeros(num_rays + 1, dtype=torch.long))
    background = torch.rand(num_rays, 3, dtype=F64)
    out = volume_render(rays_along_x(num_rays, far=7.0), samples, none, none.view(0, 1).expand(0, 3), background)
    torch.testing.assert_close(out.rgb, background)
    for depth in (out.depth, out.median_depth):
        torch.testing.assert_close(depth, torch.full((num_rays,), 7.0, dtype=F64))
    assert out.num_samples == 0


@pytest.mark.parametrize("counts", [[4, 4], [3, 0, 5]])
def test_gradients(counts: list[int]) -> None:
    samples, sigma = ragged(counts)
    if len(set(counts)) == 1:
        samples = Samples(samples.t_starts, samples.t_ends, samples.offsets, per_ray=counts[0])
    rgb = torch.rand(len(samples), 3, dtype=F64, requires_grad=True)
    rays, background = rays_along_x(len(counts), far=100.0), torch.rand(3, dtype=F64)

    def render(s: torch.Tensor, c: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        out = volume_render(rays, samples, s, c, background)
        return out.rgb, out.accumulation

    assert torch.autograd.gradcheck(render, (sigma.requires_grad_(), rgb))
