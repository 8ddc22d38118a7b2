"""Blurred step functions against numeric integration, and the loss of proposals on them."""

import pytest
import torch
from torch import Tensor

from nerfloom.kernels.histograms.step_functions import EPS, blurred_excess, blurred_excess_reference, blurred_weights
from tests.kernels.compiled import needs_kernels, relative_error

F64 = torch.float64


def histogram(rays: int, bins: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    steps = torch.rand(rays, bins, generator=generator, dtype=F64) ** 3 + 1e-3
    edges = torch.cat([torch.zeros(rays, 1, dtype=F64), steps.cumsum(-1) / steps.sum(-1, keepdim=True)], dim=-1)
    weights = torch.rand(rays, bins, generator=generator, dtype=F64) ** 4
    return edges, weights / weights.sum(-1, keepdim=True) * 0.9


def by_integration(edges: Tensor, weights: Tensor, proposed: Tensor, radius: float) -> Tensor:
    """The blurred histogram's weight in each proposed bin, by the midpoint rule on the box: float64."""
    offsets = ((torch.arange(20_000, dtype=F64) + 0.5) / 20_000 * 2 - 1) * radius
    out = torch.empty(len(edges), proposed.shape[1] - 1, dtype=F64)
    for ray in range(len(edges)):
        mass = torch.cat([weights.new_zeros(1), weights[ray].cumsum(0)])
        x = proposed[ray][:, None] + offsets
        bins = (torch.searchsorted(edges[ray], x, right=True) - 1).clamp(0, weights.shape[1] - 1)
        share = ((x - edges[ray][bins]) / (edges[ray][bins + 1] - edges[ray][bins])).clamp(0, 1)
        out[ray] = (mass[bins] + share * weights[ray][bins]).mean(-1).diff()
    return out


@pytest.mark.parametrize("radius", [0.03, 0.003, 0.5])
def test_blurred_weights_are_integrals_of_the_convolution(radius: float) -> None:
    edges, weights = histogram(4, 20)
    proposed, _ = histogram(4, 9, seed=1)
    found = blurred_weights(edges, weights, proposed, radius)
    truth = by_integration(edges, weights, proposed, radius)
    print(f"blurred weights, radius {radius}: off numeric integration by {(found - truth).abs().max():.1e}")
    assert (found - truth).abs().max().item() < 2e-7
    assert bool((found >= -1e-12).all())


def test_monte_carlo_agrees() -> None:
    """Positions drawn from the histogram and moved by draws from the box are counted in the bins."""
    torch.manual_seed(0)
    edges, weights = histogram(1, 12)
    proposed = torch.linspace(-0.2, 1.2, 15, dtype=F64)[None]
    bins = torch.multinomial(weights[0], 400_000, replacement=True)
    x = torch.lerp(edges[0][bins], edges[0][bins + 1], torch.rand(len(bins), dtype=F64))
    x += 0.1 * (2 * torch.rand(len(x), dtype=F64) - 1)
    counted = torch.histogram(x, proposed[0]).hist / len(x) * weights.sum()
    found = blurred_weights(edges, weights, proposed, 0.1)[0]
    print(f"blurred weights: off {len(x):,} draws by {(found - counted).abs().max():.1e}")
    assert (found - counted).abs().max().item() < 5 * 0.5 / len(x) ** 0.5
    assert found.sum().item() == pytest.approx(weights.sum().item(), abs=1e-12)


def test_without_blur_weights_are_those_of_the_histogram_itself() -> None:
    edges, weights = histogram(3, 8)
    found = blurred_weights(edges, weights, edges, 1e-7)
    torch.testing.assert_close(found, weights, rtol=0, atol=1e-3)
    torch.testing.assert_close(found[:, 1:-1].sum(-1), weights[:, 1:-1].sum(-1), rtol=0, atol=1e-3)


def test_a_bin_as_wide_as_the_box_becomes_a_triangle() -> None:
    """[0.4, 0.6] blurred by 0.1 either way rises from 0.3 to 0.5 and falls to 0.7, so that 1/8 lies before 0.4."""
    edges, weights = torch.tensor([[0.4, 0.6]]), torch.tensor([[1.0]])
    proposed = torch.tensor([[0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8]])
    found = blurred_weights(edges, weights, proposed, 0.1)[0]
    assert found.tolist() == pytest.approx([0, 1 / 8, 3 / 8, 3 / 8, 1 / 8, 0], abs=1e-6)


def test_bins_without_width_keep_their_weight() -> None:
    edges = torch.tensor([[0.2, 0.5, 0.5, 0.8]], dtype=F64)
    weights, proposed = torch.tensor([[0.0, 1.0, 0.0]], dtype=F64), torch.tensor([[0.0, 0.5, 1.0]], dtype=F64)
    assert blurred_weights(edges, weights, proposed, 0.1)[0].tolist() == pytest.approx([0.5, 0.5])
    excess = blurred_excess(edges.float(), weights.float(), proposed.float(), torch.full((1, 2), 0.25), 0.1)
    assert excess.item() == pytest.approx(2 * 0.25**2 / 0.25, rel=1e-3)


def test_the_loss_and_its_gradient_are_the_papers() -> None:
    edges, weights = histogram(5, 12)
    proposed, _ = histogram(5, 7, seed=1)
    own = (0.2 * torch.rand(5, 7, dtype=F64, generator=torch.Generator().manual_seed(2))).requires_grad_()
    loss = blurred_excess(edges, weights, proposed, own, 0.03)
    target = by_integration(edges, weights, proposed, 0.03)
    truth = ((target - own).clamp(min=0).square() / (own + EPS)).sum(-1)
    torch.testing.assert_close(loss, truth, rtol=1e-4, atol=1e-6)
    assert torch.autograd.gradcheck(lambda p: blurred_excess(edges, weights, proposed, p, 0.03), own)


def test_proposals_that_are_large_enough_cost_nothing_and_learn_nothing() -> None:
    edges, weights = histogram(5, 12)
    proposed, _ = histogram(5, 7, seed=1)
    own = (blurred_weights(edges, weights, proposed, 0.03).float() * 1.01 + 1e-6).requires_grad_()
    loss = blurred_excess(edges.float(), weights.float(), proposed.float(), own, 0.03)
    loss.sum().backward()
    assert loss.tolist() == [0] * 5
    assert own.grad is not None
    assert not own.grad.any()


@needs_kernels
@pytest.mark.parametrize("radius", [0.03, 0.003, 2.0])
@pytest.mark.parametrize(("bins", "proposed_bins"), [(32, 64), (1, 1), (64, 3)])
def test_compiled_values_and_gradients_are_the_references(bins: int, proposed_bins: int, radius: float) -> None:
    edges, weights = (x.float() for x in histogram(150, bins))
    proposed, _ = (x.float() for x in histogram(150, proposed_bins, seed=1))
    own = 0.5 * torch.rand(150, proposed_bins, generator=torch.Generator().manual_seed(2)) ** 3 / proposed_bins
    found = []
    for form in (blurred_excess, blurred_excess_reference):
        p = own.clone().requires_grad_()
        loss = form(edges, weights, proposed, p, radius)
        (loss * torch.linspace(0.5, 2, 150)).sum().backward()
        found.append((loss.detach(), p.grad))
    for value, truth in zip(*found, strict=True):
        assert value is not None
        assert truth is not None
        assert relative_error(value, truth) < 1e-5


def test_nan_is_seen_and_a_box_needs_a_width() -> None:
    edges, weights = (x.float() for x in histogram(2, 4))
    for name in ("weights", "proposed"):
        p, w = torch.full((2, 4), 0.1), weights.clone()
        (w if name == "weights" else p)[1, 2] = torch.nan
        assert blurred_excess(edges, w, edges, p, 0.03).isnan().tolist() == [False, True]
    with pytest.raises(ValueError, match="a radius above 0, not 0"):
        blurred_excess(edges, weights, edges, weights, 0)
