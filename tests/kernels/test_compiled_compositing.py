"""Compiled compositing and distortion against the reference in float64."""

import pytest
import torch

from nerfloom.geometry.rays import Samples
from nerfloom.kernels.compositing.density import (
    MAX_OPTICAL_DEPTH,
    Composited,
    composite,
    composite_reference,
    distortion,
)
from tests.kernels.compiled import needs_kernels, relative_error
from tests.kernels.distortion_by_pairs import distortion_by_pairs
from tests.kernels.test_compositing import ragged

COUNTS = [0, 1, 5, 0, 40, 7, 300, 0]


def inputs(scale: float = 1.0) -> tuple[Samples, list[torch.Tensor], torch.Tensor]:
    """Samples in float64 that float32 holds exactly, [sigma, rgb, background], far ends."""
    samples, sigma = ragged(COUNTS)
    samples = cast(cast(samples, torch.float32), torch.float64)
    sigma = (sigma * scale).float().double()
    generator = torch.Generator().manual_seed(3)
    rgb = torch.rand(len(sigma), 3, generator=generator, dtype=torch.float64)
    background = torch.rand(len(COUNTS), 3, generator=generator, dtype=torch.float64)
    return (
        samples,
        [sigma, rgb.float().double(), background.float().double()],
        torch.full((len(COUNTS),), 1e3, dtype=torch.float64),
    )


def cast(samples: Samples, dtype: torch.dtype) -> Samples:
    return Samples(samples.t_starts.to(dtype), samples.t_ends.to(dtype), samples.offsets)


def run(function, scale: float, dtype: torch.dtype) -> tuple[Composited, list[torch.Tensor]]:
    """The result, and the gradients of a loss that uses colour, opacity and weights."""
    samples, (sigma, rgb, background), fars = inputs(scale)
    sigma, rgb = sigma.to(dtype).requires_grad_(), rgb.to(dtype).requires_grad_()
    out = function(cast(samples, dtype), sigma, rgb, background.to(dtype), fars.to(dtype))
    loss = (out.color**2).sum() + (out.opacity * 0.3).sum() + (out.weights**2).sum()
    return out, list(torch.autograd.grad(loss, (sigma, rgb)))


@needs_kernels
@pytest.mark.parametrize("scale", [0.0, 1e-6, 0.05, 1.0, 30.0, 1e6, 1e38])
def test_value_and_gradients(scale: float) -> None:
    found, gradients = run(composite, scale, torch.float32)
    truth, true_gradients = run(composite_reference, scale, torch.float64)
    for name, a, b in zip(Composited._fields, found, truth, strict=True):
        if name != "median":  # jumps where half the light is gone; checked below
            assert relative_error(a, b) < 5e-6, name
    for a, b in zip(gradients, true_gradients, strict=True):
        assert relative_error(a, b) < 2e-5
    assert int(((found.median - truth.median).abs() > 1e-3).sum()) == 0


@needs_kernels
def test_colour_alone_and_a_shared_background() -> None:
    samples, (sigma, rgb, _), fars = inputs()
    for function, dtype in ((composite, torch.float32), (composite_reference, torch.float64)):
        s = sigma.to(dtype).requires_grad_()
        white = torch.ones(3, dtype=dtype)
        out = function(cast(samples, dtype), s, rgb.to(dtype), white, fars.to(dtype))
        (gradient,) = torch.autograd.grad(out.color.sum(), s)
        if dtype == torch.float32:
            first = gradient
    assert relative_error(first, gradient) < 2e-5
    assert out.color[0].tolist() == [1, 1, 1]


@needs_kernels
def test_nan_and_infinite_densities() -> None:
    samples = Samples(torch.arange(4.0), torch.arange(1.0, 5.0), torch.tensor([0, 2, 4]))
    rgb, background, fars = torch.rand(4, 3), torch.zeros(2, 3), torch.full((2,), 9.0)
    out = composite(samples, torch.tensor([1.0, float("nan"), 1.0, 2.0]), rgb, background, fars)
    assert bool(out.color[0].isnan().all())
    assert bool(out.color[1].isfinite().all())
    sigma = torch.tensor([0.5, torch.inf, 1.0, 2.0], requires_grad=True)
    opaque = composite(samples, sigma, rgb, background, fars)
    assert opaque.opacity[0].item() == pytest.approx(1, abs=1e-6)
    opaque.color.sum().backward()
    assert sigma.grad is not None
    assert sigma.grad[1] == 0  # beyond MAX_OPTICAL_DEPTH nothing more can be learnt
    assert bool(sigma.grad.isfinite().all())
    assert MAX_OPTICAL_DEPTH == 1e3


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_distortion_equals_the_sum_over_pairs(dtype: torch.dtype) -> None:
    samples, (sigma, _, _), _ = inputs()
    weights = (sigma / sigma.sum()).requires_grad_()
    truth = distortion_by_pairs(weights, samples)
    direction = torch.linspace(0.5, 2, len(COUNTS), dtype=torch.float64)
    (true_gradient,) = torch.autograd.grad((truth * direction).sum(), weights)
    mine = weights.detach().to(dtype).requires_grad_()
    found = distortion(mine, cast(samples, dtype))
    (gradient,) = torch.autograd.grad((found * direction.to(dtype)).sum(), mine)
    bound = 1e-12 if dtype == torch.float64 else 2e-5
    assert relative_error(found, truth) < bound
    assert relative_error(gradient, true_gradient) < bound


def test_distortion_of_one_interval_is_a_third_of_its_length() -> None:
    samples = Samples(torch.tensor([2.0]), torch.tensor([2.6]), torch.tensor([0, 1, 1]))
    torch.testing.assert_close(distortion(torch.ones(1), samples), torch.tensor([0.2, 0.0]))


@needs_kernels
def test_threads_give_the_same_bits() -> None:
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            out, gradients = run(composite, 1.0, torch.float32)
            found.append([*out, *gradients])
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for other in found[1:] for a, b in zip(found[0], other, strict=True))
