"""Opacity and density near surfaces: closed forms, NeuS's and VolSDF's claims, and extreme slopes."""

import math

import pytest
import torch
from torch import Tensor

from nerfloom.kernels.surfaces.opacity import laplace_density, surface_opacity


def plane(cosine: float, sharpness: float, count: int = 400, annealing: float = 1.0) -> tuple[Tensor, Tensor]:
    """Middles of intervals along a ray from -1 to 1 that meets a plane at t = 0, and their opacities."""
    edges = torch.linspace(-1, 1, count + 1, dtype=torch.float64)
    t, lengths = (edges[1:] + edges[:-1]) / 2, edges.diff()
    cosines = torch.full_like(t, cosine)
    return t, surface_opacity(cosine * t, cosines, lengths, torch.tensor(sharpness, dtype=torch.float64), annealing)


def weights_of(opacity: Tensor) -> Tensor:
    behind = torch.cat([opacity.new_ones(1), (1 - opacity).cumprod(0)])
    return behind[:-1] * opacity


@pytest.mark.parametrize("sharpness", [1.0, 30.0, 1e3, 1e5])
@pytest.mark.parametrize("cosine", [-1.0, -0.3, -1e-3])
def test_light_behind_a_plane_is_the_quotient_of_logistic_functions(cosine: float, sharpness: float) -> None:
    """The opacities of intervals telescope: T = S(end) / S(start) for any angle and any number of intervals."""
    for count in (1, 7, 400):
        _, opacity = plane(cosine, sharpness, count)
        logistic = torch.nn.functional.logsigmoid(torch.tensor([cosine, -cosine], dtype=torch.float64) * sharpness)
        log_transmittance = torch.log1p(-opacity.clamp(max=1 - 1e-16)).sum()
        expected = (logistic[0] - logistic[1]).item()
        if expected > -30:
            assert log_transmittance.item() == pytest.approx(expected, rel=1e-9, abs=1e-9)
        assert bool(((opacity >= 0) & (opacity <= 1)).all())


@pytest.mark.parametrize("sharpness", [20.0, 200.0, 2e4])
@pytest.mark.parametrize("cosine", [-1.0, -0.5, -0.1])
def test_the_weight_is_largest_on_the_surface(cosine: float, sharpness: float) -> None:
    """NeuS, theorem 1: unbiased to first order."""
    t, opacity = plane(cosine, sharpness, 4001)
    assert t[weights_of(opacity).argmax()].abs() <= 2 / 4001


def test_a_surface_that_a_ray_leaves_is_transparent() -> None:
    assert not plane(0.7, 50.0)[1].any()
    assert plane(0.7, 50.0, annealing=0.0)[1].max() > 0.01  # at the start of training it is not


def test_the_first_of_two_sheets_hides_the_second() -> None:
    """Sheets closer than an interval: f = |t| - 0.001 falls to the middle and rises again."""
    t = torch.linspace(-1, 1, 201, dtype=torch.float64)
    opacity = surface_opacity(t.abs() - 0.001, t.sign(), torch.full_like(t, 0.01), torch.tensor(1e4).double())
    assert weights_of(opacity)[t > 0.005].sum() < 1e-6


def test_gradients_are_those_of_differences_and_finite_everywhere() -> None:
    torch.manual_seed(0)
    distances, cosines = torch.randn(40, dtype=torch.float64) / 5, torch.randn(40, dtype=torch.float64)
    lengths, sharpness = torch.rand(40, dtype=torch.float64) / 10, torch.tensor(12.0, dtype=torch.float64)
    leaves = [each.requires_grad_() for each in (distances, cosines, lengths, sharpness)]
    for annealing in (0.0, 0.4, 1.0):
        assert torch.autograd.gradcheck(lambda *given: surface_opacity(*given, annealing), leaves)  # noqa: B023
    for size in (0.0, 1e-6, 1.0, 1e4):
        extreme = [
            torch.tensor(values).requires_grad_() for values in ([-size, size, 0.0], [-1.0, 1.0, 0.0], [1.0] * 3)
        ]
        for steep in (1e-3, 1.0, 1e5, 1e9):
            slope = torch.tensor(steep, requires_grad=True)
            opacity = surface_opacity(*extreme, slope, 0.5)
            found = torch.autograd.grad(opacity.sum(), [*extreme, slope])
            assert bool(((opacity >= 0) & (opacity <= 1)).all())
            assert all(bool(each.isfinite().all()) for each in found)


@pytest.mark.parametrize("beta", [1e-3, 0.1, 2.0])
def test_the_density_is_laplaces_distribution_function(beta: float) -> None:
    distances = torch.cat([torch.linspace(-1, 1, 101), torch.tensor([-1e6, 1e6])]).double()
    laplace = torch.distributions.Laplace(torch.tensor(0.0).double(), torch.tensor(beta).double())
    found = laplace_density(distances, torch.tensor(beta).double())
    torch.testing.assert_close(found, laplace.cdf(-distances) / beta, rtol=1e-6, atol=1e-6 / beta)


def test_light_through_the_density_of_a_plane_has_a_closed_form() -> None:
    """Optical depth from far outside to the surface: the integral of exp(-t / beta) / (2 beta) is 1 / 2."""
    t = torch.linspace(0, 5, 200_001, dtype=torch.float64)
    depth = torch.trapezoid(laplace_density(t, torch.tensor(0.05).double()), t)
    assert depth.item() == pytest.approx(0.5, rel=1e-6)
    assert math.exp(-depth) == pytest.approx(0.6065, rel=1e-4)
