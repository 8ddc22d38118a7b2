"""Stratified samples: one in each bin."""

import pytest
import torch

from nerfloom.fields.base import Field
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays
from nerfloom.samplers.uniform import LAST_INTERVAL, UniformSampler, samples_from_points, stratified_points


class Unseen(Field):
    """A uniform sampler does not look."""

    def density(self, points: Points):
        raise AssertionError

    def color(self, features, directions, camera_indices=None):
        raise AssertionError


def some_rays(count: int) -> Rays:
    nears = torch.linspace(0, 3, count)
    return Rays(torch.zeros(count, 3), torch.eye(3)[:1].expand(count, 3), nears, nears * 2 + 1)


@pytest.mark.parametrize("jitter", [True, False])
def test_one_sample_in_each_bin(jitter: bool) -> None:
    torch.manual_seed(0)
    rays = some_rays(50)
    points = stratified_points(rays, 16, jitter)
    bins = (points - rays.nears[:, None]) / (rays.fars - rays.nears)[:, None] * 16
    torch.testing.assert_close(bins.floor(), torch.arange(16.0).expand(50, 16))
    if not jitter:
        torch.testing.assert_close(bins - bins.floor(), torch.full((50, 16), 0.5), atol=1e-4, rtol=0)


def test_stratification_integrates_better_than_chance() -> None:
    """The integral of x^2 over [0, 1] has a far smaller error with 16 stratified points than with independent ones."""
    torch.manual_seed(0)
    rays = Rays(torch.zeros(2000, 3), torch.zeros(2000, 3), torch.zeros(2000), torch.ones(2000))
    error = (stratified_points(rays, 16, True) ** 2).mean(-1) - 1 / 3
    independent = (torch.rand(2000, 16) ** 2).mean(-1) - 1 / 3
    assert abs(error.mean().item()) < 1e-3  # unbiased
    assert error.std() < independent.std() / 8


def test_uniform_sampler_covers_the_ray() -> None:
    rays = some_rays(5)
    samples = UniformSampler(8).sample(rays, Unseen(), jitter=False)
    torch.testing.assert_close(samples.padded(samples.deltas).sum(-1), rays.fars - rays.nears)
    torch.testing.assert_close(samples.padded(samples.t_starts)[:, 0], rays.nears)
    torch.testing.assert_close(samples.t, (samples.t_starts + samples.t_ends) / 2)


@pytest.mark.parametrize("num_rays", [0, 2])
def test_point_samples_end_where_the_next_begins(num_rays: int) -> None:
    points = torch.tensor([1.0, 2.5, 3.0]).expand(num_rays, 3)
    samples = samples_from_points(points)
    assert samples.num_rays == num_rays
    torch.testing.assert_close(samples.t, points.reshape(-1))
    if num_rays:
        assert samples.padded(samples.deltas)[0].tolist() == pytest.approx([1.5, 0.5, LAST_INTERVAL])
