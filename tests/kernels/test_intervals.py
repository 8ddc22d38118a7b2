"""Histograms along rays: closed forms, and compiled against the reference in float64."""

import pytest
import torch

from nerfloom.kernels.encodings.contraction import contract_to_unit, contract_to_unit_reference
from nerfloom.kernels.histograms.intervals import (
    interval_weights,
    interval_weights_reference,
    proposal_excess,
    proposal_excess_reference,
    resample,
    resample_reference,
)
from tests.kernels.compiled import needs_kernels, relative_error


def histogram(rays: int, bins: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Sorted edges (rays, bins + 1) in [0, 1] and weights (rays, bins), float64 that float32 holds exactly."""
    generator = torch.Generator().manual_seed(seed)
    edges = torch.rand(rays, bins + 1, generator=generator).sort(-1).values
    weights = torch.rand(rays, bins, generator=generator) ** 4
    return edges.double(), (weights / weights.sum(-1, keepdim=True).clamp(min=1e-9)).float().double()


@needs_kernels
@pytest.mark.parametrize(("rays", "bins"), [(0, 5), (1, 1), (7, 3), (33, 64)])
@pytest.mark.parametrize("scale", [1.0, 1e4, 1e-4])
def test_weights(rays: int, bins: int, scale: float) -> None:
    edges, density = histogram(rays, bins)
    density = (density * scale * bins).float().double()
    found = []
    for function, dtype in ((interval_weights, torch.float32), (interval_weights_reference, torch.float64)):
        sigma = density.to(dtype).requires_grad_()
        out = function(sigma, edges.to(dtype))
        factors = torch.linspace(-1, 2, bins, dtype=dtype)
        found.append((out, torch.autograd.grad((out * factors).sum(), sigma)[0]))
    for value, truth in zip(*found, strict=True):
        assert relative_error(value, truth) < 1e-4


def test_weights_of_two_intervals() -> None:
    """Half of the light is stopped by the first, and half of the rest by the second."""
    t = torch.tensor([[1.0, 2.0, 4.0]])
    sigma = torch.tensor([[1.0, 0.5]]) * torch.log(torch.tensor(2.0))
    torch.testing.assert_close(interval_weights(sigma, t), torch.tensor([[0.5, 0.25]]))


def test_infinite_density_takes_all() -> None:
    sigma, t = torch.tensor([[0.0, torch.inf, 1.0, torch.inf]]), torch.tensor([[0.0, 1.0, 2.0, 2.0, 3.0]])
    torch.testing.assert_close(interval_weights(sigma, t), torch.tensor([[0.0, 1.0, 0.0, 0.0]]))


@needs_kernels
@pytest.mark.parametrize(("rays", "bins", "count"), [(0, 4, 3), (1, 1, 1), (9, 5, 20), (31, 64, 32)])
@pytest.mark.parametrize(("power", "padding"), [(1.0, 0.01), (0.5, 0.0)])
def test_resampling(rays: int, bins: int, count: int, power: float, padding: float) -> None:
    edges, weights = histogram(rays, bins)
    shift = torch.rand(rays, generator=torch.Generator().manual_seed(1))
    compiled = resample(edges.float(), weights.float(), shift, count, power, padding)
    reference = resample_reference(edges, weights, shift.double(), count, power, padding)
    assert compiled.shape == (rays, count + 1)
    assert relative_error(compiled, reference) < 1e-4
    assert bool((compiled.diff(dim=-1) >= 0).all())
    assert bool((compiled >= edges[:, :1].float()).all())
    assert bool((compiled <= edges[:, -1:].float()).all())


@pytest.mark.parametrize("function", [resample, resample_reference])
def test_new_edges_are_quantiles(function) -> None:
    """All weight lies in the second of three bins: so do the new edges, evenly."""
    edges, weights = torch.tensor([[0.0, 1.0, 2.0, 3.0]]), torch.tensor([[0.0, 1.0, 0.0]])
    found = function(edges, weights, torch.tensor([0.5]), 3, 1.0, 0.0)
    torch.testing.assert_close(found, torch.tensor([[1.125, 1.375, 1.625, 1.875]]))


def test_a_ray_without_weight_is_sampled_everywhere() -> None:
    edges, nothing = torch.tensor([[0.0, 1.0, 2.0]]), torch.zeros(1, 2)
    assert resample(edges, nothing, torch.tensor([0.5]), 7, 1.0, 0.01)[0].tolist() == [
        i / 8 + 1 / 8 for i in range(0, 16, 2)
    ]
    assert bool(torch.isfinite(resample(edges, nothing, torch.tensor([0.5]), 7, 1.0, 0.0)).all())


@needs_kernels
@pytest.mark.parametrize(("rays", "bins", "proposed"), [(0, 4, 3), (1, 1, 1), (9, 5, 20), (40, 32, 64)])
def test_excess(rays: int, bins: int, proposed: int) -> None:
    edges, weights = histogram(rays, bins)
    others, guess = histogram(rays, proposed, seed=1)
    found = []
    for function, dtype in ((proposal_excess, torch.float32), (proposal_excess_reference, torch.float64)):
        p = guess.to(dtype).requires_grad_()
        out = function(edges.to(dtype), weights.to(dtype), others.to(dtype), p)
        found.append((out, torch.autograd.grad((out * torch.arange(rays, dtype=dtype)).sum(), p)[0]))
    for value, truth in zip(*found, strict=True):
        assert relative_error(value, truth) < 1e-3


@pytest.mark.parametrize("function", [proposal_excess, proposal_excess_reference])
def test_excess_in_closed_form(function) -> None:
    """An interval of weight 0.9 inside a proposed one of 0.5 has 0.4 too much; a bounded interval costs nothing."""
    edges, weights = torch.tensor([[0.1, 0.2, 0.6]]), torch.tensor([[0.9, 0.1]])
    proposed, guess = torch.tensor([[0.0, 0.5, 1.0]]), torch.tensor([[0.5, 0.5]], requires_grad=True)
    loss = function(edges, weights, proposed, guess)
    torch.testing.assert_close(loss, torch.tensor([0.16 / 0.9]))
    (grad,) = torch.autograd.grad(loss.sum(), guess)
    torch.testing.assert_close(grad, torch.tensor([[-0.8 / 0.9, 0.0]]))


def test_a_histogram_bounds_itself() -> None:
    edges, weights = histogram(20, 16)
    assert bool((proposal_excess(edges, weights, edges, weights) == 0).all())


BOX = torch.tensor([[-1.0, -2.0, 0.0], [3.0, 2.0, 4.0]], dtype=torch.float64)


@needs_kernels
def test_contraction() -> None:
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(400, 3, generator=generator)
    positions = torch.cat([directions * 10 ** torch.linspace(-6, 15, 400)[:, None], torch.zeros(1, 3), BOX.float()])
    factors = torch.rand(len(positions), 3, generator=generator)
    found = []
    for function, dtype in ((contract_to_unit, torch.float32), (contract_to_unit_reference, torch.float64)):
        x = positions.to(dtype).requires_grad_()
        out = function(x, BOX.to(dtype))
        found.append((out, torch.autograd.grad((out * factors.to(dtype)).sum(), x)[0]))
    (value, grad), (truth, true_grad) = found
    assert bool(((value >= 0) & (value <= 1)).all())
    assert relative_error(value, truth) < 1e-6
    scale = true_grad.norm(dim=-1, keepdim=True)
    outside = positions.norm(dim=-1) > 1e4  # there the derivative along the ray is below float32's rounding
    error = ((grad.double() - true_grad).abs() / scale).amax(-1)
    assert float(error[~outside].max()) < 1e-4
    assert float(error.max()) < 1e-2
    assert bool(torch.isfinite(grad).all())


def test_contraction_of_the_extremes() -> None:
    box = torch.tensor([[-1.0] * 3, [1.0] * 3])
    extremes = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [1e30, 0.0, 0.0], [torch.inf, 0, 0]])
    expected = torch.tensor([0.5, 0.75, 0.875, 1.0, 1.0])
    torch.testing.assert_close(contract_to_unit(extremes, box)[:, 0], expected)
