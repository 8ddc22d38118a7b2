"""Compositing of opacities: from transparent to opaque, thin and long rows of them, NaN, rays without samples."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from nerfloom.geometry.rays import Rays, Samples
from nerfloom.rendering.rendered import Rendered
from nerfloom.rendering.volume import volume_render
from tests.stress.backends import FEW, backends

LEAK = 1.01 * torch.finfo(torch.float32).eps ** 0.5
"""The share of light that gets through an opacity of 1."""
BACKGROUND = torch.tensor([0.1, 0.2, 0.3])
CLEAR = st.sampled_from([0.0, 1e-30, 1e-9, 1e-4, 0.3, 0.9, 0.999])
"""Opacities that leave light."""


def row(alphas: list[list[float]], requires_grad: bool = False) -> tuple[Rays, Samples, Tensor, Tensor]:
    """Rays along x, their samples in intervals of different lengths, opacities and colours."""
    counts, flat = [len(ray) for ray in alphas], [alpha for ray in alphas for alpha in ray]
    generator = torch.Generator().manual_seed(0)
    lengths = torch.rand(len(flat), generator=generator) + 0.1
    starts = torch.cat([1 + torch.cumsum(part, 0) - part for part in lengths.split(counts)] or [lengths])
    offsets = torch.tensor([0, *counts]).cumsum(0)
    fars = torch.arange(len(counts)) + 100.0
    rays = Rays(torch.zeros(len(counts), 3), torch.eye(3)[:1].expand(len(counts), 3), torch.zeros_like(fars), fars)
    rgb = torch.rand(len(flat), 3, generator=generator).requires_grad_(requires_grad)
    return rays, Samples(starts, starts + lengths, offsets), torch.tensor(flat).requires_grad_(requires_grad), rgb


def composited(alphas: list[list[float]]) -> Rendered:
    rays, samples, alpha, rgb = row(alphas)
    return volume_render(rays, samples, alpha, rgb, BACKGROUND, is_alpha=True)


def products(alpha: Tensor) -> Tensor:
    """Weights of one ray's opacities: NeuS, equation 10."""
    left = torch.cat([torch.ones_like(alpha[:1]), torch.cumprod(1 - alpha, 0)[:-1]])
    return left * alpha


@pytest.mark.medium
@pytest.mark.entry(4, 11)
@backends()
@FEW
@given(alphas=st.lists(st.lists(CLEAR, max_size=5), min_size=1, max_size=4))
def test_pictures_and_gradients_are_those_of_products(backend: str, alphas: list[list[float]]) -> None:
    """Rays with and without samples are compared with float64; lengths of intervals do not matter."""
    rays, samples, alpha, rgb = row(alphas, requires_grad=True)
    out = volume_render(rays, samples, alpha, rgb, BACKGROUND, is_alpha=True)
    factors = torch.tensor([[1.0, -0.5, 2.0]])
    out.rgb.mul(factors).sum().backward()
    exact_alpha, exact_rgb = (values.detach().double().requires_grad_() for values in (alpha, rgb))
    colors, parts = [], [len(ray) for ray in alphas]
    for index, (a, c, t) in enumerate(zip(*(x.split(parts) for x in (exact_alpha, exact_rgb, samples.t)), strict=True)):
        weights = products(a)
        opacity = weights.sum()
        colors.append((weights[:, None] * c).sum(0) + (1 - opacity) * BACKGROUND)
        assert out.accumulation[index].item() == pytest.approx(opacity.item(), rel=2e-5, abs=1e-37)
        if opacity.item() > 1e-5:
            assert out.depth[index].item() == pytest.approx(((weights * t).sum() / opacity).item(), rel=1e-4)
        elif opacity.item() < 1e-7:
            assert out.depth[index] == rays.fars[index]
        behind = (torch.cumprod(1 - a, 0) < 0.5).nonzero()
        assert out.median_depth[index] == (t[behind[0, 0]] if len(behind) else rays.fars[index])
    truth = torch.stack(colors)
    (truth * factors).sum().backward()
    torch.testing.assert_close(out.rgb, truth.float(), rtol=1e-5, atol=1e-6)
    for found, exact in ((alpha, exact_alpha), (rgb, exact_rgb)):
        assert found.grad is not None
        assert exact.grad is not None
        torch.testing.assert_close(found.grad.double(), exact.grad, rtol=1e-3, atol=1e-4)


@pytest.mark.entry(11)
@backends()
def test_a_thousand_thin_opacities_are_not_lost(backend: str) -> None:
    """1 - 1e-9 is 1 in float32, and no product of ones would ever become less."""
    found = composited([[1e-9] * 1000])
    assert found.accumulation.item() == pytest.approx(1e-6, rel=1e-4)
    assert found.weights is not None
    assert bool((found.weights > 0.99e-9).all())


@pytest.mark.entry(11)
@backends()
@pytest.mark.parametrize("alpha", [1.0, 1 - 2.0**-24, 1 - 2.0**-13])
def test_what_is_opaque_hides_what_is_behind_and_can_learn(backend: str, alpha: float) -> None:
    """LEAK is the part that gets through, and the gradient of 1 / (1 - alpha) is finite."""
    rays, samples, alphas, rgb = row([[0.25, alpha, 0.5]], requires_grad=True)
    out = volume_render(rays, samples, alphas, rgb, BACKGROUND, is_alpha=True)
    exact = alphas.detach().double()
    weights = products(exact)
    truth = (weights[:, None] * rgb.detach()).sum(0) + (1 - weights.sum()) * BACKGROUND
    assert (out.rgb[0].detach() - truth).abs().max().item() <= LEAK
    assert 1 - LEAK <= out.accumulation.item() <= 1 + 1e-6
    assert out.median_depth[0] == samples.t[1]
    out.rgb.sum().backward()
    assert alphas.grad is not None
    behind = 0.5 * rgb[2].detach() + 0.5 * BACKGROUND
    assert alphas.grad[1].item() == pytest.approx(0.75 * (rgb[1].detach() - behind).sum().item(), rel=1e-2, abs=1e-3)
    assert alphas.grad[2].abs().item() <= 2 * LEAK


@pytest.mark.entry(12)
@backends()
def test_a_nan_opacity_is_seen_on_its_ray_and_on_no_other(backend: str) -> None:
    rays, samples, alpha, rgb = row([[0.5, math.nan, 0.5], [0.5, 0.25]], requires_grad=True)
    out = volume_render(rays, samples, alpha, rgb, BACKGROUND, is_alpha=True)
    assert out.rgb.isnan().all(-1).tolist() == [True, False]
    assert out.accumulation.isnan().tolist() == [True, False]
    assert out.weights is not None
    assert out.weights[3:].tolist() == pytest.approx([0.5, 0.125], rel=1e-6)
    out.rgb.sum().backward()
    assert alpha.grad is not None
    assert not bool(alpha.grad[:3].isfinite().all())
    assert bool(alpha.grad[3:].isfinite().all())


@pytest.mark.entry(1, 11)
@backends()
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_opacities_are_composited_in_single(backend: str, dtype: torch.dtype) -> None:
    rays, samples, alpha, rgb = row([[0.1] * 50, [0.9, 1.0]])
    found = volume_render(rays, samples, alpha.to(dtype), rgb.to(dtype), BACKGROUND, is_alpha=True)
    rounded = [values.to(dtype).float() for values in (alpha, rgb)]
    truth = volume_render(rays, samples, *rounded, BACKGROUND, is_alpha=True)
    assert found.rgb.dtype == torch.float32
    assert torch.equal(found.rgb, truth.rgb)
    assert torch.equal(found.median_depth, truth.median_depth)
