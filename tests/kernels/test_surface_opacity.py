"""Opacity and density near surfaces: closed forms, random flights, NeuS's and VolSDF's claims, and extreme slopes."""

import math
from collections.abc import Callable

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


WIDTHS = 40.0
"""Distance from a surface beyond which it is transparent or opaque to float64, in widths 1 / s."""


def along_a_ball(offset: float, start: float, sharpness: float) -> tuple[Tensor, Tensor]:
    """Distances f and opacities of intervals of a ray, (t, 0, offset) from t = `start`, that passes a ball of 0.5.

    The intervals are short where the distance is within `WIDTHS` of the surface, and where it changes its sign.
    """
    share = torch.linspace(0, 1, 20_001, dtype=torch.float64)
    near = torch.lerp(share.new_tensor(-WIDTHS), share.new_tensor(WIDTHS), share) / sharpness
    radii = (near + 0.5).clamp(min=offset)
    inwards = -(radii.square() - offset**2).clamp(min=0).sqrt()
    middle = torch.lerp(share.new_tensor(-1.0), share.new_tensor(1.0), share).pow(3) * min(1.0, 4 / sharpness**0.5)
    edges = torch.cat([torch.lerp(share.new_tensor(start), share.new_tensor(1.0), share), inwards, -inwards, middle])
    edges = edges[(edges >= start) & (edges <= 1)].unique()
    t, lengths = (edges[1:] + edges[:-1]) / 2, edges.diff()
    radii = (t.square() + offset**2).sqrt()
    return radii - 0.5, surface_opacity(radii - 0.5, t / radii, lengths, torch.tensor(sharpness, dtype=torch.float64))


@pytest.mark.parametrize("sharpness", [1.0, 30.0, 1e3, 1e5])
@pytest.mark.parametrize(
    ("offset", "start"),
    [(0.0, -1.0), (0.3, -1.0), (0.5, -1.0), (0.5 + 1e-5, -1.0), (0.7, -1.0), (0.1, -0.2), (0.1, 0.2)],
)
def test_light_past_a_ball_depends_on_the_least_distance(offset: float, start: float, sharpness: float) -> None:
    """T = S(least) / S(first) for rays that hit, graze, miss and start inside; one that leaves loses no light."""
    _, opacity = along_a_ball(offset, start, sharpness)
    first, least = math.hypot(start, offset) - 0.5, math.hypot(max(start, 0.0), offset) - 0.5
    logistic = torch.nn.functional.logsigmoid(torch.tensor([least, first], dtype=torch.float64) * sharpness)
    truth = math.exp(logistic[0] - logistic[1])
    assert (1 - opacity).prod().item() == pytest.approx(truth, rel=1e-3, abs=1e-12)


@pytest.mark.parametrize("sharpness", [30.0, 1e3, 1e4])
@pytest.mark.parametrize("offset", [0.1, 0.3, 0.4])
def test_the_weight_on_a_ball_is_largest_a_second_order_before_it(offset: float, sharpness: float) -> None:
    """NeuS is unbiased for planes. Before a ball of radius r, met at the cosine c, the error is 2 o^2 / r^3 s^2 c^2."""
    cosine = (1 - (offset / 0.5) ** 2) ** 0.5
    bias = 2 * offset**2 / (0.5**3 * sharpness**2 * cosine**2)
    edges = -0.5 * cosine + bias / cosine * torch.linspace(-20, 20, 4002, dtype=torch.float64)
    t, lengths = (edges[1:] + edges[:-1]) / 2, edges.diff()
    radii = (t.square() + offset**2).sqrt()
    weights = weights_of(surface_opacity(radii - 0.5, t / radii, lengths, torch.tensor(sharpness).double()))
    assert (radii[weights.argmax()] - 0.5).item() == pytest.approx(bias, rel=0.1)


SHAPES: dict[str, Callable[[Tensor], Tensor]] = {
    "plane": lambda p: 0.8 * p[..., 2] - 0.6 * p[..., 0],
    "grazed plane": lambda p: 0.02 * p[..., 2] - 0.9998 * p[..., 0],
    "ball": lambda p: (p - torch.tensor([0.0, 0.0, -6.0])).norm(dim=-1) - 6.0,
    "two sheets": lambda p: torch.minimum(p[..., 2].abs(), (p[..., 2] + 3.0).abs()) - 0.5,
}
"""Signed distances, in widths of the surface; rays go down along z, and pass x = 0, 1 or 2."""


@pytest.mark.medium
@pytest.mark.parametrize("kind", ["neus", "volsdf"])
@pytest.mark.parametrize("sharpness", [1.0, 1e5])
@pytest.mark.parametrize("name", SHAPES)
def test_light_is_that_of_random_flights(name: str, sharpness: float, kind: str) -> None:
    """Photons that fly through the continuous density, and collide at random (Woodcock tracking), in float64."""
    torch.manual_seed(0)
    unit = 1 / sharpness
    top, bottom = (90.0, -60.0) if name == "grazed plane" else (20.0, -14.0)
    slope = torch.tensor(sharpness, dtype=torch.float64)

    def distance_and_cosine(x: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
        depth = t.clone().requires_grad_()
        places = torch.stack([x, torch.zeros_like(x), top * unit - depth], -1) / unit
        found = SHAPES[name](places) * unit
        (cosine,) = torch.autograd.grad(found.sum(), depth)
        return found.detach(), cosine

    def density(x: Tensor, t: Tensor) -> Tensor:
        distance, cosine = distance_and_cosine(x, t)
        if kind == "volsdf":
            return laplace_density(distance, 1 / slope)
        return slope * torch.sigmoid(-slope * distance) * torch.relu(-cosine)  # NeuS, equation 10

    count, length = 20_000, (top - bottom) * unit
    for place in (0.0, 1.0, 2.0):
        x = torch.full((count,), place * unit, dtype=torch.float64)
        end, flying = torch.zeros(count, dtype=torch.float64), torch.arange(count)
        while len(flying):
            end[flying] += torch.empty(len(flying), dtype=torch.float64).exponential_() * unit
            collides = torch.rand(len(flying)).double() < density(x[flying], end[flying]) * unit
            flying = flying[~collides & (end[flying] < length)]
        edges = torch.linspace(0, length, 6001, dtype=torch.float64)
        t = (edges[1:] + edges[:-1]) / 2
        distance, cosine = distance_and_cosine(x[:1].expand(6000), t)
        if kind == "volsdf":
            left = torch.exp(-(laplace_density(distance, 1 / slope) * edges.diff()).cumsum(0))
        else:
            left = (1 - surface_opacity(distance, cosine, edges.diff(), slope)).cumprod(0)
        for number in range(500, 6000, 500):
            flown = (end > edges[number + 1]).double().mean().item()
            assert flown == pytest.approx(left[number].item(), abs=4 * 0.5 / count**0.5), (place, number)


@pytest.mark.parametrize("thickness", [0.1, 0.5, 1.05])
def test_a_plate_as_thick_as_a_step_is_opaque_and_a_thinner_one_by_chance(thickness: float) -> None:
    """The middle of a step is before the plate or in its nearer half, with the chance 1/2 + thickness / 2."""
    found = caught(lambda t: (t - thickness / 2).abs() - thickness / 2)
    assert found == pytest.approx(min(0.5 + thickness / 2, 1.0), abs=2e-3)


def test_two_sheets_closer_than_a_step_catch_more_light_than_one() -> None:
    """Sheets 0.1 thick with 0.3 between them: also the farther half of the gap and the second's nearer half count."""
    found = caught(lambda t: torch.minimum((t - 0.05).abs(), (t - 0.45).abs()) - 0.05)
    assert found == pytest.approx(0.5 + 0.05 + 0.15 + 0.05, abs=2e-3)


def caught(distance: Callable[[Tensor], Tensor]) -> float:
    """The mean opacity of a distance along a ray, in steps of length 1 from a random place, with a sharp surface."""
    shift = (torch.arange(1000, dtype=torch.float64) + 0.5)[:, None] / 1000
    t = (torch.arange(-5, 6, dtype=torch.float64) + shift).requires_grad_()
    found = distance(t)
    (cosine,) = torch.autograd.grad(found.sum(), t)
    opacity = surface_opacity(found.detach(), cosine, torch.ones_like(t), torch.tensor(1e5).double())
    return float(1 - (1 - opacity.detach()).prod(-1).mean())


@pytest.mark.parametrize("beta", [1.0, 1e-2, 1e-5])
@pytest.mark.parametrize("cosine", [1.0, 0.3, 1e-3])
def test_light_through_a_plane_has_a_closed_form_at_any_angle(cosine: float, beta: float) -> None:
    """VolSDF's optical depth from afar to h behind the surface, at an angle c: (h / beta + exp(-h / beta) / 2) / c."""
    f = torch.linspace(40, -3, 200_001, dtype=torch.float64) * beta
    density = laplace_density(f, torch.tensor(beta, dtype=torch.float64))
    found = torch.cumulative_trapezoid(density, -f / cosine)
    for behind in (0.0, 0.5, 3.0):
        at = int((f[1:] / beta + behind).abs().argmin())
        h = -f[at + 1].item() / beta
        truth = (0.5 * math.exp(h) if h < 0 else h + 0.5 * math.exp(-h)) / cosine
        assert found[at].item() == pytest.approx(truth, rel=1e-6)
