"""Compositing of alphas against the plain product formula, in float64."""

import math

import pytest
import torch
from torch import Tensor

from nerfloom.geometry.rays import Samples
from nerfloom.kernels.compositing.alpha import alpha_depth, composite_alpha
from tests.kernels.test_compositing import ragged

F64 = torch.float64
COUNTS = [7, 0, 1, 40, 3]


def product_formula(alpha: Tensor, rgb: Tensor, background: Tensor, counts: list[int]) -> tuple[Tensor, Tensor, Tensor]:
    """Colour (R, 3), opacity (R,) and weights (N,), one sample after the other."""
    colors, opacities, weights, start = [], [], [], 0
    for count in counts:
        left, color, opacity = alpha.new_ones(()), alpha.new_zeros(3), alpha.new_zeros(())
        for n in range(start, start + count):
            weight = left * alpha[n]
            color, opacity, left = color + weight * rgb[n], opacity + weight, left * (1 - alpha[n])
            weights.append(weight)
        colors.append(color + left * background)
        opacities.append(opacity)
        start += count
    return torch.stack(colors), torch.stack(opacities), torch.stack(weights)


def case(kind: str, dtype: torch.dtype = F64) -> tuple[Samples, Tensor, Tensor, Tensor, Tensor]:
    """Samples, alpha, rgb, background and far ends."""
    samples, _ = ragged(COUNTS)
    draws = torch.Generator().manual_seed(3)
    alpha = torch.rand(len(samples), generator=draws, dtype=F64) ** 3
    if kind == "with zeros":
        alpha[::3] = 0
    if kind == "with ones":
        alpha[[2, 5, 20, 40]] = 1
    if kind == "all ones":
        alpha[:] = 1
    rgb = torch.rand(len(samples), 3, generator=draws, dtype=F64)
    background = torch.tensor([0.2, 0.7, 1.0], dtype=F64)
    samples = Samples(samples.t_starts.to(dtype), samples.t_ends.to(dtype), samples.offsets)
    return samples, alpha.to(dtype), rgb.to(dtype), background.to(dtype), torch.full((len(COUNTS),), 99.0, dtype=dtype)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("kind", ["soft", "with zeros", "with ones", "all ones"])
def test_value_and_gradient_are_those_of_the_product(kind: str, dtype: torch.dtype) -> None:
    """float32 takes the compiled kernel where there is one. The bound at an alpha of 1 is the documented sqrt(eps)."""
    samples, alpha, rgb, background, fars = case(kind, dtype)
    draws = torch.Generator().manual_seed(4)
    seeds = [torch.randn(shape, generator=draws, dtype=F64) for shape in ((5, 3), (5,), (len(samples),))]

    def values_and_gradients(composite, alpha: Tensor, rgb: Tensor) -> list[Tensor]:
        alpha, rgb = alpha.clone().requires_grad_(), rgb.clone().requires_grad_()
        found = composite(alpha, rgb)
        total = sum((value * seed.to(value)).sum() for value, seed in zip(found, seeds, strict=True))
        return [value.detach() for value in found] + list(torch.autograd.grad(total, (alpha, rgb)))

    def ours(alpha: Tensor, rgb: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        found = composite_alpha(samples, alpha, rgb, background, fars)
        return found.color, found.opacity, found.weights

    found = values_and_gradients(ours, alpha, rgb)
    wanted = values_and_gradients(
        lambda a, c: product_formula(a, c, background.double(), COUNTS), alpha.double(), rgb.double()
    )
    bound = math.sqrt(torch.finfo(dtype).eps) if "ones" in kind else 100 * torch.finfo(dtype).eps
    errors = [(one.double() - other).abs().max().item() for one, other in zip(found, wanted, strict=True)]
    print(
        f"alpha, {kind}, {dtype}: colour, opacity, weights, gradients off by " + ", ".join(f"{e:.1e}" for e in errors)
    )
    assert all(error <= 1.001 * bound for error in errors[:3])  # 1 - bound is rounded
    assert all(error <= 20 * bound for error in errors[3:])  # of gradients of up to some 20
    assert max(value.abs().max().item() for value in wanted[3:]) > 1


def test_depths_are_those_of_the_samples() -> None:
    samples, _, rgb, background, fars = case("soft")
    alpha = torch.zeros(len(samples), dtype=F64)
    opaque = [3, 9, 30, 49]  # one on each ray that has samples
    alpha[opaque] = 1
    found = composite_alpha(samples, alpha, rgb, background, fars)
    seen = torch.tensor([True, False, False, True, True])
    rays = samples.ray_indices[opaque]
    assert rays.tolist() == [0, 3, 3, 4]
    torch.testing.assert_close(found.median[seen], samples.t[[3, 9, 49]], rtol=1e-12, atol=0)
    torch.testing.assert_close(found.moment[seen], samples.t[[3, 9, 49]], rtol=1e-6, atol=0)
    assert found.median[~seen].tolist() == [99.0, 99.0]


def test_a_flat_of_samples_a_ray_is_composited_alike() -> None:
    edges = torch.linspace(0, 1, 9, dtype=F64).expand(4, -1)
    flat = Samples.regular(edges[:, :-1], edges[:, 1:])
    packed = Samples(flat.t_starts, flat.t_ends, flat.offsets)
    draws = torch.Generator().manual_seed(0)
    alpha, rgb = torch.rand(32, generator=draws, dtype=F64), torch.rand(32, 3, generator=draws, dtype=F64)
    ends = torch.ones(4, dtype=F64)
    for one, other in zip(*(composite_alpha(s, alpha, rgb, rgb[:4], ends) for s in (flat, packed)), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-14)


def test_nan_stays_where_it_is() -> None:
    samples, alpha, rgb, background, fars = case("soft")
    alpha[10] = torch.nan  # on the fourth ray
    found = composite_alpha(samples, alpha, rgb, background, fars)
    assert found.color.isnan().any(-1).tolist() == [False, False, False, True, False]
    assert bool(alpha_depth(alpha)[10].isnan())


def test_depth_of_half_precision_is_float32() -> None:
    alpha = torch.tensor([0.0, 0.5, 1.0], dtype=torch.bfloat16)
    depth = alpha_depth(alpha)
    assert depth.dtype == torch.float32
    assert depth[0] == 0
    assert depth[1].item() == pytest.approx(math.log(2))
    assert depth[2].item() == pytest.approx(-math.log(torch.finfo(torch.float32).eps) / 2, rel=1e-4)
