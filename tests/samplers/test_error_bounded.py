"""VolSDF's bound of the opacity's error, against fine quadrature in float64, and the samples that keep it."""

from collections.abc import Callable
from typing import Any, cast

import pytest
import torch
from torch import Tensor

from nerfloom.fields.surface import VolSDFField
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.surfaces.opacity import laplace_density
from nerfloom.samplers.error_bounded import (
    ErrorBoundedSampler,
    bounded_opacity,
    bounding_beta,
    nearest_in_intervals,
)

Distance = Callable[[Tensor], Tensor]
SCENES: dict[str, Distance] = {
    "ball": lambda x: x.norm(dim=-1) - 0.5,
    "plane": lambda x: x @ torch.tensor([0.6, 0.0, 0.8], dtype=x.dtype) - 0.1,
    "two sheets": lambda x: torch.minimum((x[..., 2] - 0.03).abs(), (x[..., 2] + 0.03).abs()) - 0.004,
    "nothing": lambda x: x.norm(dim=-1) + 2.0,
}
BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]], dtype=torch.float64)
FINE = 20_000


class Exact:
    """An exact distance with VolSDF's density."""

    def __init__(self, distance: Distance, beta: float) -> None:
        self.distance, self.beta, self.asked = distance, beta, 0

    def signed_distance(self, points: Points) -> Tensor:
        self.asked += len(points.positions)
        return self.distance(points.positions)

    def sharpness(self) -> Tensor:
        return torch.tensor(1 / self.beta, dtype=torch.float64)


def rays(count: int = 60) -> Rays:
    """Rays through a box from outside: some miss the surfaces, some graze them."""
    torch.manual_seed(0)
    origins = 2 * torch.nn.functional.normalize(torch.randn(count, 3, dtype=torch.float64), dim=-1)
    towards = torch.rand(count, 3, dtype=torch.float64) * 1.2 - 0.6
    return Rays(origins, torch.nn.functional.normalize(towards - origins, dim=-1))


def distances_along(some: Rays, distance: Distance, t: Tensor) -> Tensor:
    return distance(some.origins[:, None] + some.directions[:, None] * t[..., None])


def true_opacity(some: Rays, distance: Distance, t: Tensor, beta: Tensor) -> Tensor:
    """The opacity up to each place, by the trapezoid rule in `FINE` steps from the first place to the last."""
    share = torch.linspace(0, 1, FINE + 1, dtype=torch.float64)
    fine = torch.lerp(t[:, :1], t[:, -1:], share)
    sigma = laplace_density(distances_along(some, distance, fine), beta)
    depth = torch.cumulative_trapezoid(sigma, fine, dim=-1)
    depth = torch.nn.functional.pad(depth, (1, 0))
    place = (t - t[:, :1]) / (t[:, -1:] - t[:, :1]) * FINE
    low = place.floor().long().clamp(0, FINE - 1)
    return -torch.expm1(-torch.lerp(depth.gather(-1, low), depth.gather(-1, low + 1), place - low))


@pytest.mark.parametrize(
    "sizes", [(0.3, 0.4, 0.5), (0.3, 0.4, 0.2), (0.1, 0.2, 0.5), (0.5, 0.2, 0.31), (0.2, 0.2, 0.01)]
)
def test_nearest_is_that_of_a_place_outside_both_balls(sizes: tuple[float, float, float]) -> None:
    """Brute force: the places of a fine grid that are in neither ball, and their distances to the interval."""
    first, last, length = sizes
    x, y = torch.meshgrid(torch.linspace(-1, 1.5, 2501), torch.linspace(0, 1, 1001), indexing="ij")
    outside = (torch.hypot(x, y) >= first) & (torch.hypot(x - length, y) >= last)
    away = torch.hypot(x - x.clamp(0, length), y)
    found = nearest_in_intervals(torch.tensor([[first, -last]]), torch.tensor([[length]]))
    assert float(found) == pytest.approx(float(away[outside].min()), abs=2e-3)


@pytest.mark.parametrize("beta", [0.1, 0.01, 0.002])
@pytest.mark.parametrize("name", SCENES)
def test_opacity_is_within_its_bound(name: str, beta: float) -> None:
    """Places are random, dense and sparse ones; the bound is tight where samples are dense."""
    some, width = rays(), torch.tensor(beta, dtype=torch.float64)
    for count in (16, 2000):
        t = torch.rand(len(some), count, dtype=torch.float64).sort(dim=-1).values * 3 + 0.5
        opacity, bound = bounded_opacity(t, distances_along(some, SCENES[name], t), width)
        error = (opacity - true_opacity(some, SCENES[name], t, width)).abs()[:, 1:]
        print(name, beta, count, float(error.max()), float(bound.max()))
        assert bool((error <= bound + 1e-6).all())
    assert float(bound.max()) < 1 or beta < 0.01


@pytest.mark.parametrize("name", SCENES)
def test_samples_are_added_until_the_bound_holds(name: str) -> None:
    """The opacity is within epsilon of the truth, and most rays need no blurred density for that."""
    some, field = rays(), Exact(SCENES[name], 0.02)
    sampler = ErrorBoundedSampler(BOX, num_steps=64)
    t, distances, beta = sampler.bounded(some, cast("VolSDFField", field), jitter=True)
    hit = t[:, -1] > t[:, 0]
    assert int(hit.sum()) > 20
    opacity, bound = bounded_opacity(t, distances, beta)
    error = (opacity - true_opacity(some, SCENES[name], t, beta)).abs()[hit]
    print(name, t.shape, float((beta == 0.02).double().mean()), float(error.max()), float(bound.max()))
    assert float(bound.max()) <= sampler.epsilon
    assert float(error.max()) <= sampler.epsilon
    assert float((beta == 0.02).double().mean()) > 0.5  # the others look along a sheet, or graze the ball


def test_a_density_too_sharp_for_the_samples_is_blurred() -> None:
    """The bound holds for a larger beta, and not for a beta a tenth smaller."""
    some, beta = rays(), torch.tensor(1e-4, dtype=torch.float64)
    t = torch.linspace(1, 3, 33, dtype=torch.float64).expand(len(some), -1)
    distances = distances_along(some, SCENES["ball"], t)
    first = torch.full((len(some), 1), 2.0, dtype=torch.float64)
    found = bounding_beta(t, distances, beta, first, 0.1)
    assert bool((bounded_opacity(t, distances, found).error <= 0.1).all())
    blurred = found[:, 0] > beta
    assert int(blurred.sum()) > 20
    assert bool((bounded_opacity(t, distances, 0.9 * found).error.amax(-1) > 0.1)[blurred].all())


def test_samples_lie_where_the_opacity_rises() -> None:
    """Contiguous intervals from the box's near to its far side, most of them around the surface."""
    some, field = rays(), Exact(SCENES["ball"], 0.01)
    sampler = ErrorBoundedSampler(BOX, num_samples=32)
    samples = sample_exact(sampler, some, field)
    starts, ends = samples.padded(samples.t_starts), samples.padded(samples.t_ends)
    torch.testing.assert_close(starts[:, 1:], ends[:, :-1])
    distances = distances_along(some, SCENES["ball"], (starts + ends) / 2)
    along = -(some.origins * some.directions).sum(-1, keepdim=True)
    hit = (some.origins + along * some.directions).norm(dim=-1) < 0.4
    near = (distances.abs() < 0.1).double().mean(-1)
    assert int(hit.sum()) > 10
    assert float(near[hit].min()) > 0.6


def sample_exact(sampler: ErrorBoundedSampler, some: Rays, field: Exact) -> Any:
    """Samples of an exact distance, which the sampler takes for a field."""
    known = cast("Any", VolSDFField.__new__(VolSDFField))
    torch.nn.Module.__init__(known)
    known.signed_distance, known.sharpness = field.signed_distance, field.sharpness
    return sampler.sample(some, known, jitter=False)
