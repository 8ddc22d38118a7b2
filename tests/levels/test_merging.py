"""Merged Gaussians: their moments, surfaces and coverage in closed form."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from nerfloom.levels.merging import GROUP, covariances, halved, merged, nearby_order, surfaces
from nerfloom.splats.gaussians import Gaussians
from tests.levels.made import cloud


def balls(*centers: tuple[float, float, float], size: float = 0.5, opacity: float = 0.2) -> Gaussians:
    """Spheres of one size and opacity, each of another colour."""
    count = len(centers)
    colors = torch.arange(3.0 * count).view(count, 3) / 10
    turns = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    logits = torch.full((count,), math.log(opacity / (1 - opacity)))
    scales = torch.full((count, 3), math.log(size))
    return Gaussians(torch.tensor(centers), scales, turns, logits, colors, torch.ones(count, 3, 3))


def covered(gaussians: Gaussians) -> torch.Tensor:
    return torch.sigmoid(gaussians.logits.double()) * surfaces(gaussians.log_scales)


def test_surfaces_of_spheres_discs_and_spheroids() -> None:
    c, a = 3.0, 1.0
    e = math.sqrt(1 - a * a / (c * c))
    prolate = 2 * math.pi * a * a * (1 + c / (a * e) * math.asin(e))
    axes = torch.tensor([[2.0, 2.0, 2.0], [2.0, 2.0, 1e-9], [a, a, c]])
    expected = torch.tensor([16 * math.pi, 8 * math.pi, prolate], dtype=torch.float64)
    found = surfaces(axes.log())
    assert float(found[0]) == pytest.approx(16 * math.pi)
    torch.testing.assert_close(found, expected, rtol=0.011, atol=0)


def test_two_in_one_place_are_one_of_twice_the_opacity() -> None:
    found = merged(balls((1.0, 2.0, 3.0), (1.0, 2.0, 3.0)), 2)
    torch.testing.assert_close(found.means, torch.tensor([[1.0, 2.0, 3.0]]))
    torch.testing.assert_close(found.log_scales.exp(), torch.full((1, 3), 0.5))
    assert float(found.logits.sigmoid()) == pytest.approx(0.4, abs=1e-5)
    torch.testing.assert_close(found.colors, torch.tensor([[0.15, 0.25, 0.35]]))
    assert torch.equal(found.harmonics, torch.ones(1, 3, 3))


def test_two_side_by_side_are_longer_and_fainter() -> None:
    """The variance along their line is their own and the square of the distance from the middle."""
    found = merged(balls((-2.0, 0.0, 0.0), (2.0, 0.0, 0.0)), 2)
    torch.testing.assert_close(found.means, torch.zeros(1, 3))
    expected = torch.diag(torch.tensor([4.25, 0.25, 0.25], dtype=torch.float64))[None]
    torch.testing.assert_close(covariances(found), expected, rtol=1e-5, atol=1e-6)
    a, c = 0.5, math.sqrt(4.25)
    e = math.sqrt(1 - a * a / (c * c))
    surface = 2 * math.pi * a * a * (1 + c / (a * e) * math.asin(e))
    assert float(found.logits.sigmoid()) == pytest.approx(2 * 0.2 * math.pi / surface, rel=0.012)


def test_weights_are_opacity_times_surface() -> None:
    pair = balls((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
    larger = replace(pair, log_scales=torch.tensor([0.5, 1.0]).log()[:, None].repeat(1, 3))  # four times the surface
    assert float(merged(larger, 2).means[0, 0]) == pytest.approx(4 / 5)
    fainter = replace(pair, logits=torch.logit(torch.tensor([0.6, 0.2])))
    assert float(merged(fainter, 2).means[0, 0]) == pytest.approx(1 / 4)
    torch.testing.assert_close(merged(fainter, 2).colors[0], 0.75 * pair.colors[0] + 0.25 * pair.colors[1])


def test_moments_are_those_of_the_mixture() -> None:
    given = cloud(12)
    found = merged(given, 4)
    weights, means, spread = covered(given).numpy(), given.means.double().numpy(), covariances(given).numpy()
    for group in range(3):
        some = slice(4 * group, 4 * group + 4)
        share = weights[some] / weights[some].sum()
        mean = (share[:, None] * means[some]).sum(0)
        second = sum(w * (c + np.outer(m, m)) for w, c, m in zip(share, spread[some], means[some], strict=True))
        np.testing.assert_allclose(found.means[group], mean, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(covariances(found)[group], second - np.outer(mean, mean), rtol=1e-4, atol=1e-6)


def test_overlapping_ones_are_opaque_and_extreme_ones_finite() -> None:
    assert float(merged(balls(*[(0.0, 0.0, 0.0)] * 4, opacity=0.9), 4).logits.sigmoid()) == pytest.approx(1, abs=1e-6)
    for size, logit in ((1e-30, 0.0), (1e30, 0.0), (1.0, -200.0), (1.0, 200.0)):
        given = replace(balls(*[(0.0, 0.0, 0.0)] * 4, size=size), logits=torch.full((4,), logit))
        assert bool(merged(given, 4).drawable().all()), (size, logit)


@pytest.mark.parametrize("count", [1, 4, 44, 64])
def test_groups_are_of_neighbours(count: int) -> None:
    """Groups of four around centres that differ along every axis."""
    random = torch.Generator().manual_seed(0)
    groups = -(-count // GROUP)
    centers = torch.stack([torch.randperm(groups, generator=random) for _ in range(3)], -1).float()
    shuffled = torch.randperm(count, generator=random)
    group = (torch.arange(count) // GROUP)[shuffled]
    points = centers[group] + 1e-3 * torch.rand(count, 3, generator=random)
    order = nearby_order(points, GROUP)
    assert sorted(order.tolist()) == list(range(count))
    found = group[order][: count // GROUP * GROUP].view(-1, GROUP)
    assert bool((found == found[:, :1]).all())


@pytest.mark.parametrize("count", [1, 2, 3, 7, 8, 100, 1003])
def test_half_are_left_and_cover_as_much(count: int) -> None:
    faint = replace(cloud(count), logits=torch.full((count,), -6.0))  # nothing becomes opaque
    errors = torch.zeros(count)
    found, left = halved(faint, errors)
    assert len(found) == len(left) <= max(count / 2, min(count, 4))
    torch.testing.assert_close(covered(found).sum(), covered(faint).sum(), rtol=1e-5, atol=0)
    before = (covered(faint)[:, None] * faint.means).sum(0)
    torch.testing.assert_close((covered(found)[:, None] * found.means).sum(0), before, rtol=1e-4, atol=1e-6)
    made = left > 0
    torch.testing.assert_close(left[made], found.log_scales.exp().amax(1)[made])
    again, further = halved(found, left)
    assert not len(left) or float(further.max()) >= float(left.max())
    assert len(again) == len(further)


def test_large_ones_and_those_far_away_stay() -> None:
    given = cloud(96)
    given.log_scales[:3] = 1.0
    given.means[3:5] += torch.tensor([[100.0, 0, 0], [0, 100.0, 0]])
    found, errors = halved(given, torch.zeros(96))
    stayed = {tuple(row) for row in found.means[errors == 0].tolist()}
    assert {tuple(row) for row in given.means[:5].tolist()} <= stayed
    assert len(found) == 48
