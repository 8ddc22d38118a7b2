"""Relocation: Gaussians move to where gradients and opacities are large, and the picture stays."""

import math

import pytest
import torch
from torch import Tensor

from nerfloom.kernels.splats.project import RECORD
from nerfloom.splats.drawing import splat_camera
from nerfloom.splats.mcmc import DEAD, GROWTH, growth
from nerfloom.splats.relocation import GRADIENT_WEIGHT, OPACITY_WEIGHT, Relocation, sampling_scores
from tests.splats.test_mcmc import some
from tests.splats.test_method import camera


def watched(gradients: Tensor) -> Relocation:
    """A strategy that has seen these mean gradients (N,)."""
    strategy = Relocation()
    strategy.gradients.sums = torch.stack([3 * gradients, torch.full_like(gradients, 3.0)], 1)  # in three images
    return strategy


def test_scores_are_the_weighted_sum_of_relative_gradients_and_opacities() -> None:
    gradients, opacities = torch.tensor([1e-5, 3e-5, 2e-5]), torch.tensor([0.2, 0.1, 0.6])
    expected = [
        GRADIENT_WEIGHT * float(g) / 2e-5 + OPACITY_WEIGHT * float(o) / 0.3
        for g, o in zip(gradients, opacities, strict=True)
    ]
    torch.testing.assert_close(sampling_scores(gradients, opacities), torch.tensor(expected))
    torch.testing.assert_close(sampling_scores(1e3 * gradients, opacities), torch.tensor(expected))  # of any unit
    without = sampling_scores(torch.zeros(3), opacities)
    torch.testing.assert_close(without, OPACITY_WEIGHT * opacities / 0.3)
    broken = sampling_scores(torch.tensor([1.0, 1.0]), torch.tensor([0.5, math.nan]))
    assert bool(broken[0].isfinite())


def test_large_gradients_are_chosen_more_often() -> None:
    """Two equally opaque ones are chosen in proportion to their scores: 0.5 and 1.5."""
    torch.manual_seed(1)
    gaussians = some(4_000, torch.zeros(4_000))
    gradients = torch.tensor([0.0, 2e-4]).repeat(2_000)
    change = watched(gradients).grow(gaussians, 10**6, 1.0)
    assert change is not None
    assert len(change.kept) + len(change.fresh) == int(GROWTH * 4_000)
    gone = torch.ones(4_000, dtype=torch.bool).index_fill_(0, change.kept, False)  # they have become copies
    share = float(gone[1::2].sum() / gone.sum())
    assert share == pytest.approx(0.75, abs=0.15)


def test_dead_ones_move_and_no_more_than_the_maximum_are_there() -> None:
    gaussians = some(10, torch.tensor([3.0] * 6 + [-9.0] * 3 + [math.nan]))
    change = watched(torch.rand(10)).grow(gaussians, 10, 1.0)
    assert change is not None
    assert len(change.kept) + len(change.fresh) == 10
    live = {tuple(mean.tolist()) for mean in gaussians.means[:6]}
    assert {tuple(mean.tolist()) for mean in change.fresh.means} <= live
    assert float(torch.sigmoid(change.fresh.logits).min()) >= DEAD
    assert bool(change.fresh.finite().all())
    assert growth(100, 102) == 2
    assert growth(100, 50) == 0


def test_gradients_are_those_of_the_images_since_the_last_change() -> None:
    strategy, seen = Relocation(), splat_camera(camera(), 0.1)
    records = torch.ones(3, RECORD, requires_grad=True)
    shown = records * 1.0
    strategy.watch(shown, seen)
    (shown * torch.tensor([0.0, 1.0, 2.0])[:, None]).sum().backward()
    strategy.after_every_step(True)
    found = strategy.gradients.take(3)
    assert float(found[0]) == 0
    assert float(found[2]) == pytest.approx(2 * float(found[1]))
    assert not bool(strategy.gradients.take(3).any())


def test_only_the_image_that_is_watched_last_counts() -> None:
    strategy, seen = Relocation(), splat_camera(camera(), 0.1)
    first, second = (torch.ones(3, RECORD, requires_grad=True) * 1.0 for _ in range(2))
    for shown in (first, second):
        strategy.watch(shown, seen)
    (5 * first + second * torch.tensor([0.0, 1.0, 2.0])[:, None]).sum().backward()
    strategy.after_every_step(True)
    found = strategy.gradients.take(3)
    assert float(found[0]) == 0
    assert float(found[2]) == pytest.approx(2 * float(found[1]))
