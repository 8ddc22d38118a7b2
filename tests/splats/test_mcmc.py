"""Moves of Gaussians: pictures do not change, and only nearly transparent Gaussians get noise."""

import pytest
import torch
from torch import Tensor

from nerfloom.kernels.splats.project import rotation_matrices
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.mcmc import DEAD, MAX_COPIES, faint, moved, noise, shared


def some(count: int, logits: Tensor | None = None) -> Gaussians:
    """Random Gaussians, opaque unless told."""
    logits = torch.full((count,), 3.0) if logits is None else logits
    means, log_scales = torch.randn(count, 3), torch.randn(count, 3) * 0.3 - 2
    return Gaussians(means, log_scales, torch.randn(count, 4), logits, torch.randn(count, 3), torch.randn(count, 3, 3))


@pytest.mark.parametrize("alpha", [0.02, 0.5, 0.9, 0.99])
@pytest.mark.parametrize("count", [2, 3, 7])
def test_copies_at_one_place_look_like_the_one(alpha: float, count: int) -> None:
    """Where they lie, and in sum along a line: the integral that the paper's equation equates."""
    logit = torch.tensor([alpha], dtype=torch.float64).logit()
    logits, log_scales = shared(logit, torch.zeros(1, 3, dtype=torch.float64), torch.tensor([count]))
    each, scale = torch.sigmoid(logits), float(log_scales[0, 0].exp())
    if alpha > count * DEAD:
        assert 1 - (1 - float(each)) ** count == pytest.approx(alpha, rel=1e-6)
    x = torch.linspace(-12, 12, 20_001, dtype=torch.float64)
    one = torch.trapezoid(alpha * torch.exp(-(x**2) / 2), x)
    copies = torch.trapezoid(1 - (1 - each * torch.exp(-(x**2) / (2 * scale**2))) ** count, x)
    if alpha > count * DEAD:
        assert float(copies) == pytest.approx(float(one), rel=1e-4)


def test_many_copies_in_float32_stay_as_in_float64() -> None:
    """The sum over binomials alternates, so that float32 would keep one or two digits of it."""
    logits = torch.linspace(-4, 16, 40)
    counts = torch.full((40,), MAX_COPIES)
    single = shared(logits, torch.zeros(40, 3), counts)
    double = shared(logits.double(), torch.zeros(40, 3, dtype=torch.float64), counts)
    torch.testing.assert_close(single[0].double(), double[0], atol=1e-3, rtol=1e-4)
    torch.testing.assert_close(single[1].double(), double[1], atol=1e-3, rtol=0)


def test_dead_ones_move_to_live_ones_and_others_are_added() -> None:
    gaussians = some(10, torch.tensor([3.0] * 6 + [-9.0] * 3 + [torch.nan]))
    change = moved(gaussians, added=5)
    assert change is not None
    kept, fresh = change
    assert len(kept) + len(fresh) == 15
    assert set(kept.tolist()) <= set(range(6))
    live = {tuple(mean.tolist()) for mean in gaussians.means[:6]}
    assert {tuple(mean.tolist()) for mean in fresh.means} <= live
    assert not {tuple(gaussians.means[i].tolist()) for i in kept} & {tuple(mean.tolist()) for mean in fresh.means}
    assert bool(fresh.finite().all())


def test_nothing_to_move_is_nothing() -> None:
    assert moved(some(4), added=0) is None
    assert moved(some(4, torch.full((4,), -9.0)), added=3) is None  # there is nowhere to go


def test_opaque_ones_are_chosen_more_often() -> None:
    torch.manual_seed(1)
    gaussians = some(2, torch.tensor([0.5, 0.1]).logit())
    change = moved(gaussians, added=40)
    assert change is not None
    counts = [int((change[1].means == mean).all(1).sum()) for mean in gaussians.means]
    assert counts[0] / sum(counts) == pytest.approx(5 / 6, abs=0.05)


def test_noise_has_the_gaussians_own_shape_and_ends_with_opacity() -> None:
    torch.manual_seed(2)
    count = 40_000
    one = some(1, torch.tensor([DEAD]).logit())
    many = one.map(lambda values: values.expand(count, *values.shape[1:]))
    which, by = faint(many.logits), noise(many, size=2.0)
    assert which is not None
    assert len(which) == count
    axes = rotation_matrices(one.rotations)[0] * one.log_scales[0].exp()
    covariance = axes @ axes.T
    expected = covariance @ covariance  # half of it squared, as the gate is 1 / 2 there, times 2.0 squared
    torch.testing.assert_close(by.T @ by / count, expected, atol=0.03 * float(expected.norm()), rtol=0)
    opaque = faint(some(5).logits)
    assert opaque is not None
    assert len(opaque) == 0
