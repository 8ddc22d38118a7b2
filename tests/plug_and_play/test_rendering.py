"""`nerfloom.render`: the results of a user's functions, composited; values and gradients."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

import nerfloom
from benchmarks.sampling import random_rays
from nerfloom.geometry.rays import Samples
from tests.kernels.test_compositing import ragged

F64 = torch.float64
COUNTS = [4, 0, 1, 6]


def rays_for(samples: Samples) -> nerfloom.Rays:
    """Along different directions, float64, with far ends behind all samples."""
    draws = torch.Generator().manual_seed(1)
    directions = torch.randn(samples.num_rays, 3, generator=draws, dtype=F64)
    origins = torch.randn(samples.num_rays, 3, generator=draws, dtype=F64)
    fars = torch.full((samples.num_rays,), 50.0, dtype=F64)
    return nerfloom.Rays(origins, torch.nn.functional.normalize(directions, dim=-1), torch.zeros_like(fars), fars)


def by_hand(samples: Samples, alpha: Tensor, values: Tensor, behind: Tensor) -> Tensor:
    """(R, C) sums of values (N, C) under the products of the samples' transmittances, over `behind` (C,)."""
    rows, start = [], 0
    for count in samples.counts.tolist():
        left, row = alpha.new_ones(()), values.new_zeros(values.shape[1])
        for n in range(start, start + count):
            row, left = row + left * alpha[n] * values[n], left * (1 - alpha[n])
        rows.append(row + left * behind)
        start += count
    return torch.stack(rows)


def evaluated(values: Tensor, sigma: Tensor, **extras: Tensor) -> Callable[..., tuple]:
    """A field that has been evaluated already."""
    return lambda positions, directions: (values, sigma, extras)


@pytest.fixture
def case() -> tuple[nerfloom.Rays, Samples, Tensor, Tensor, Tensor]:
    """Rays, samples, sigma, rgb and background, float64."""
    samples, sigma = ragged(COUNTS)
    draws = torch.Generator().manual_seed(2)
    rgb = torch.rand(len(samples), 3, generator=draws, dtype=F64)
    return rays_for(samples), samples, sigma, rgb, torch.tensor([0.3, 0.6, 0.9], dtype=F64)


@pytest.mark.parametrize("kind", ["sigma", "alpha"])
def test_values_are_those_of_the_product_formula(case, kind: str) -> None:
    rays, samples, sigma, rgb, background = case
    alpha = -torch.expm1(-sigma * samples.deltas)
    semantics = torch.randn(len(samples), 2, 5, dtype=F64)
    chosen = {"rgb_sigma_fn": evaluated(rgb, sigma, semantics=semantics, gloss=rgb[:, 0])}
    if kind == "alpha":
        chosen = {"rgb_alpha_fn": evaluated(rgb, alpha, semantics=semantics, gloss=rgb[:, 0])}
    found = nerfloom.render(rays, samples, background=background, **chosen)
    nothing = torch.zeros(10, dtype=F64)
    wanted = {
        "rgb": by_hand(samples, alpha, rgb, background),
        "accumulation": by_hand(samples, alpha, torch.ones_like(alpha)[:, None], nothing[:1])[:, 0],
    }
    for name, value in wanted.items():
        torch.testing.assert_close(getattr(found, name), value, rtol=1e-12, atol=1e-14)
    assert sorted(found.extras) == ["gloss", "semantics"]
    summed = by_hand(samples, alpha, semantics.flatten(1), nothing).view(-1, 2, 5)
    torch.testing.assert_close(found.extras["semantics"], summed, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(found.extras["gloss"], by_hand(samples, alpha, rgb[:, :1], nothing[:1])[:, 0])
    moment = by_hand(samples, alpha, samples.t[:, None], nothing[:1])[:, 0]
    seen = found.accumulation > 0
    torch.testing.assert_close(found.depth[seen], (moment / found.accumulation)[seen], rtol=1e-12, atol=0)
    assert found.depth[1] == 50


@pytest.mark.parametrize("kind", ["sigma", "alpha"])
def test_gradients_are_those_of_finite_differences(case, kind: str) -> None:
    """The gradients by density or alpha, colours and a further property are compared, in float64."""
    rays, samples, sigma, rgb, background = case
    values = sigma if kind == "sigma" else (0.05 + 0.9 * sigma / sigma.max())
    extra = torch.randn(len(samples), 2, dtype=F64)

    def rendered(values: Tensor, rgb: Tensor, extra: Tensor, background: Tensor) -> tuple[Tensor, ...]:
        function = evaluated(rgb, values, extra=extra)
        chosen = {f"rgb_{kind}_fn": function}
        found = nerfloom.render(rays, samples, background=background, **chosen)
        return found.rgb, found.accumulation, found.weights, found.extras["extra"]

    inputs = [value.clone().requires_grad_() for value in (values, rgb, extra, background)]
    assert torch.autograd.gradcheck(rendered, inputs)


def test_the_compiled_kernel_gives_the_same_gradients(case) -> None:
    """float32, the type of a training loop, is compared with float64."""

    def gradients(dtype: torch.dtype) -> list[Tensor]:
        rays, samples, sigma, rgb, background = case
        rays = nerfloom.Rays(*(getattr(rays, name).to(dtype) for name in ("origins", "directions", "nears", "fars")))
        samples = Samples(samples.t_starts.to(dtype), samples.t_ends.to(dtype), samples.offsets)
        leaves = [value.to(dtype).clone().requires_grad_() for value in (sigma, rgb, rgb[:, :2])]
        found = nerfloom.render(rays, samples, evaluated(leaves[1], leaves[0], own=leaves[2]), background.to(dtype))
        total = found.rgb.square().sum() + found.accumulation.square().sum() + found.extras["own"].square().sum()
        return [*torch.autograd.grad(total, leaves), found.rgb.detach()]

    for one, other in zip(gradients(torch.float32), gradients(F64), strict=True):
        torch.testing.assert_close(one.double(), other, rtol=1e-4, atol=1e-5)


def test_a_function_is_asked_where_the_samples_are_and_from_where_they_are_seen(case) -> None:
    rays, samples, sigma, rgb, _ = case

    def function(positions: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        owners = samples.ray_indices
        wanted = rays.origins[owners] + samples.t[:, None] * rays.directions[owners]
        torch.testing.assert_close(positions, wanted)
        torch.testing.assert_close(directions, rays.directions[owners])
        return rgb, sigma

    assert nerfloom.render(rays, samples, function).rgb.shape == (4, 3)


def test_rays_have_the_gradient_of_finite_differences(case) -> None:
    """Through positions and directions, so that poses can be learnt; t does not move."""
    rays, samples, *_ = case

    def rendered(origins: Tensor, directions: Tensor) -> Tensor:
        def function(positions: Tensor, seen_along: Tensor) -> tuple[Tensor, Tensor]:
            return torch.sigmoid(positions + seen_along), positions.square().sum(-1)

        return nerfloom.render(nerfloom.Rays(origins, directions), samples, function).rgb

    # Turned about, directions leave the unit sphere by less than the tolerance for length 1.
    assert torch.autograd.gradcheck(rendered, [rays.origins.requires_grad_(), rays.directions.requires_grad_()])


@pytest.mark.parametrize("background", [0.5, (0.5, 0.5, 0.5), torch.full((3,), 0.5), torch.full((4, 3), 0.5)])
def test_backgrounds(case, background) -> None:
    rays, samples, sigma, rgb, _ = case
    found = nerfloom.render(rays, samples, evaluated(rgb, sigma), background)
    wanted = by_hand(samples, -torch.expm1(-sigma * samples.deltas), rgb, torch.full((3,), 0.5, dtype=F64))
    torch.testing.assert_close(found.rgb, wanted)


def test_a_sum_under_detached_weights_teaches_the_property_alone(case) -> None:
    rays, samples, sigma, rgb, _ = case
    sigma, features = sigma.requires_grad_(), torch.rand(len(samples), 7, dtype=F64, requires_grad=True)
    found = nerfloom.render(rays, samples, evaluated(rgb, sigma))
    total = nerfloom.accumulate(samples, found.weights.detach(), features)
    assert total.shape == (4, 7)
    (gradient,) = torch.autograd.grad(total.sum(), features)
    torch.testing.assert_close(gradient, found.weights.detach()[:, None].expand(-1, 7))


def test_half_precision_is_composited_in_float32() -> None:
    """Autocast is such a case: thin samples' optical depth would be lost."""
    edges = torch.linspace(0, 1, 1001).expand(1, -1)
    samples = Samples.regular(edges[:, :-1], edges[:, 1:])
    rays = nerfloom.Rays(torch.zeros(1, 3), torch.tensor([[1.0, 0, 0]]))
    ones = torch.ones(1000, 3, dtype=torch.bfloat16)
    found = nerfloom.render(rays, samples, lambda x, d: (ones, ones[:, 0], {"own": ones}))
    assert found.rgb.dtype == found.extras["own"].dtype == torch.float32
    assert found.accumulation.item() == pytest.approx(1 - math.exp(-1), abs=1e-5)


def test_a_sphere_by_its_signed_distance() -> None:
    """NeuS, equation 13: alpha from the signed distance at an interval's two ends; the surface is where it is 0."""
    grid = nerfloom.OccupancyGrid([[-1.0] * 3, [1.0] * 3], 32, 256)
    rays = random_rays(400, seed=0)
    sharpness, radius = 200.0, 0.6
    samples = nerfloom.sample(rays, None, grid)

    def rgb_alpha_fn(positions: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        half = (samples.deltas / 2)[:, None] * directions
        before, after = (torch.sigmoid(sharpness * ((positions + way * half).norm(dim=-1) - radius)) for way in (-1, 1))
        normals = positions / positions.norm(dim=-1, keepdim=True)
        return 0.5 + 0.5 * normals, ((before - after) / before.clamp(min=1e-9)).clamp(min=0), {"normals": normals}

    found = nerfloom.render(rays, samples, rgb_alpha_fn=rgb_alpha_fn)
    middle = -(rays.origins * rays.directions).sum(-1)
    miss = (rays.origins + middle[:, None] * rays.directions).norm(dim=-1)
    hit = middle - (radius**2 - miss.square()).clamp(min=0).sqrt()
    clear, through = miss > radius + 0.05, miss < radius - 0.05
    assert clear.sum() > 50
    assert through.sum() > 50
    torch.testing.assert_close(found.accumulation[through], torch.ones(int(through.sum())), rtol=0, atol=1e-3)
    assert found.accumulation[clear].max() < 1e-3
    torch.testing.assert_close(found.depth[through], hit[through], rtol=0, atol=0.02)
    normals = (rays.origins + hit[:, None] * rays.directions) / radius
    torch.testing.assert_close(found.extras["normals"][through], normals[through], rtol=0, atol=0.05)


def test_what_is_wrong_is_said(case) -> None:
    rays, samples, sigma, rgb, _ = case
    with pytest.raises(ValueError, match=r"rgb_sigma_fn returned sigma of shape \(11, 1\).*\(11,\): squeeze"):
        nerfloom.render(rays, samples, evaluated(rgb, sigma[:, None]))
    with pytest.raises(ValueError, match=r"rgb_alpha_fn returned rgb of shape \(11, 2\)"):
        nerfloom.render(rays, samples, rgb_alpha_fn=evaluated(rgb[:, :2], sigma))
    with pytest.raises(ValueError, match=r"returned gloss of shape \(4,\); it must be a tensor of shape \(11,\)"):
        nerfloom.render(rays, samples, evaluated(rgb, sigma, gloss=sigma[:4]))
    with pytest.raises(ValueError, match="returned gloss of shape float"):
        nerfloom.render(rays, samples, evaluated(rgb, sigma, gloss=1.0))
    for functions in ({}, {"rgb_sigma_fn": evaluated(rgb, sigma), "rgb_alpha_fn": evaluated(rgb, sigma)}):
        with pytest.raises(ValueError, match="either rgb_sigma_fn or rgb_alpha_fn"):
            nerfloom.render(rays, samples, **functions)
    with pytest.raises(ValueError, match="samples are of 4 rays, but there are 2"):
        nerfloom.render(rays[:2], samples, evaluated(rgb, sigma))
