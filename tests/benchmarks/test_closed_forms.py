"""The scenes' truth against quadrature in float64 that knows nothing of them but their density and colour."""

import math

import pytest
import torch
from torch import Tensor

from benchmarks.closed_forms import (
    BOX,
    Ball,
    Blobs,
    Block,
    ClosedForm,
    Gaussian,
    Light,
    Medium,
    Solids,
    gauss_legendre,
    mean_place,
    scenes,
)
from nerfloom.geometry.points import Points
from nerfloom.geometry.rays import Rays

F64 = torch.float64
BACKGROUND = torch.tensor([1.0, 0.3, 0.0], dtype=F64)
POINTS = 2**15


def rays_from(origins: Tensor, targets: Tensor, near: float, far: float) -> Rays:
    directions = torch.nn.functional.normalize(targets - origins, dim=-1)
    return Rays(origins, directions, torch.full((len(origins),), near), torch.full((len(origins),), far))


def awkward_rays() -> Rays:
    """Rays from outside, from inside, past everything, and along the axes: inside, outside and in the fog's faces."""
    draws = torch.Generator().manual_seed(0)
    outside = torch.nn.functional.normalize(torch.randn(10, 3, generator=draws, dtype=F64), dim=-1) * 4
    inside = torch.rand(10, 3, generator=draws, dtype=F64) - 0.5
    towards = torch.rand(10, 3, generator=draws, dtype=F64) * 1.6 - 0.8
    axes = torch.eye(3, dtype=F64).repeat(3, 1)
    across = torch.tensor([[0.45, 0.5, 0.55], [0.9, 0.9, 0.9], [0.8, 0.7, 0.6]], dtype=F64).repeat_interleave(3, 0)
    parts = [
        rays_from(outside, towards, 2.0, 6.0),
        rays_from(inside, towards, 0.0, 3.0),
        rays_from(inside, towards, 0.2, 0.7),
        rays_from(outside, 2 * outside, 0.0, 5.0),
        Rays(torch.where(axes == 1, -3.0, across), axes, torch.zeros(9), torch.full((9,), 5.0)),
        Rays(torch.where(axes == 1, 0.1, across), -axes, torch.zeros(9), torch.full((9,), 0.5)),
    ]
    columns = [[getattr(part, name) for part in parts] for name in ("origins", "directions", "nears", "fars")]
    return Rays(*(torch.cat(column).double() for column in columns))


def by_quadrature(scene: ClosedForm, rays: Rays, jumps: bool) -> Light:
    """Ray by ray, in `POINTS` even intervals and more ends where density jumps, which bisection finds."""
    colors, opacities = [], []
    for o, d, near, far in zip(rays.origins, rays.directions, rays.nears, rays.fars, strict=True):

        def at(t: Tensor, o: Tensor = o, d: Tensor = d) -> tuple[Tensor, Tensor]:
            return scene.density(Points(o + t[:, None] * d))

        ends = near + (far - near) * torch.linspace(0, 1, POINTS + 1, dtype=F64)
        if jumps:
            sigma, _ = at(ends)
            before = (sigma[1:] != sigma[:-1]).nonzero().squeeze(-1)
            low, high = ends[before], ends[before + 1]
            for _ in range(40 if len(before) else 0):
                middle = (low + high) / 2
                same = at(middle)[0] == sigma[before]
                low, high = torch.where(same, middle, low), torch.where(same, high, middle)
            ends = torch.cat([ends, low, high]).sort().values
        sigma, color = at((ends[1:] + ends[:-1]) / 2)
        tau = sigma * ends.diff()
        weights = torch.exp(-(tau.cumsum(0) - tau)) * (1 - torch.exp(-tau))
        left = torch.exp(-tau.sum())
        colors.append((weights[:, None] * color).sum(0) + left * BACKGROUND)
        opacities.append(1 - left)
    return Light(torch.stack(colors), torch.stack(opacities))


@pytest.mark.medium
@pytest.mark.parametrize("name", scenes())
def test_truth_is_what_dense_quadrature_finds(name: str) -> None:
    scene, rays = scenes()[name], awkward_rays()
    truth, found = scene.truth(rays, BACKGROUND), by_quadrature(scene, rays, jumps=isinstance(scene, Solids))
    errors = [(a - b).abs().max().item() for a, b in zip(truth, found, strict=True)]
    print(f"{name}: colour off by at most {errors[0]:.1e}, opacity by {errors[1]:.1e}")
    assert all(error < 1e-6 for error in errors)
    assert truth.color.dtype == truth.opacity.dtype == F64
    past = slice(30, 40)
    torch.testing.assert_close(truth.color[past], BACKGROUND.expand(10, 3), rtol=0, atol=1e-12)
    assert bool((truth.opacity > 0.1).any())


@pytest.mark.parametrize("name", scenes())
def test_scenes_lie_in_their_box_and_have_colours(name: str) -> None:
    draws = torch.Generator().manual_seed(0)
    positions = (torch.rand(200_000, 3, generator=draws) * 2 - 1) * 2
    sigma, color = scenes()[name].density(Points(positions))
    outside = ((positions < BOX[0]) | (positions > BOX[1])).any(-1)
    assert sigma.dtype == torch.float32
    assert sigma[outside].max().item() < 1e-5
    assert sigma.max().item() > 0.5
    assert bool(((color >= 0) & (color <= 1)).all())


def test_through_the_middle_of_a_ball() -> None:
    """A ball has two radii of one colour; of a hollow ball the walls remain."""
    ball, hollow = Medium(Ball(0.5), 3.0, (0.2, 0.4, 0.6)), Medium(Ball(0.4), 0.0)
    ray = rays_from(torch.tensor([[0.0, 0.0, 2.0]]), torch.zeros(1, 3), 0.0, 4.0)
    for scene, length in ((Solids(ball), 1.0), (Solids(ball, hollow), 0.2)):
        opacity = 1 - math.exp(-3 * length)
        found = scene.truth(ray, torch.zeros(3))
        assert found.opacity.item() == pytest.approx(opacity, rel=1e-12)
        assert found.color[0].tolist() == pytest.approx([0.2 * opacity, 0.4 * opacity, 0.6 * opacity], rel=1e-12)


def test_a_linear_colour_in_fog() -> None:
    """Red grows with x from 0: the integral of exp(-2 s) 2 s ds from 0 to 1."""
    scene = Solids(Medium(Block((0.0, -1.0, -1.0), (1.0, 1.0, 1.0)), 2.0, slope=(1.0, 0.0, 0.0)))
    ray = rays_from(torch.tensor([[-1.0, 0.0, 0.0]]), torch.zeros(1, 3), 0.0, 4.0)
    found = scene.truth(ray, torch.zeros(3)).color[0]
    assert found.tolist() == pytest.approx([0.5 - 1.5 * math.exp(-2), 0.0, 0.0], abs=1e-12)


def test_gaussians_of_one_colour_need_no_quadrature() -> None:
    grey = (0.5, 0.5, 0.5)
    scene = Blobs(Gaussian((0.0, 0.0, 0.0), 0.1, 40.0, grey), Gaussian((0.1, 0.2, 0.1), 0.05, 90.0, grey))
    rays = awkward_rays()
    found = scene.truth(rays, torch.zeros(3))
    error = (found.color - 0.5 * found.opacity[:, None]).abs().max().item()
    print(f"Gaussians of one colour: off by at most {error:.1e}")
    assert error < 1e-10


def test_directions_need_not_be_of_length_one() -> None:
    """They are rounded to float32. Twice as long ones make half of the distance, and so half of the optical depth."""
    rays = awkward_rays()[:10]
    longer = Rays(rays.origins, 2 * rays.directions, rays.nears / 2, rays.fars / 2)
    for scene in scenes().values():
        expected, found = scene.truth(rays, BACKGROUND).opacity, scene.truth(longer, BACKGROUND).opacity
        torch.testing.assert_close((1 - found).square(), 1 - expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("tau", [0.0, 1e-9, 9.99e-3, 1.001e-2, 0.5, 30.0, 1e4])
def test_the_mean_place_at_which_light_is_stopped(tau: float) -> None:
    nodes, weights = (torch.from_numpy(values) for values in gauss_legendre(2000, 8))
    stopped = weights * torch.exp(-tau * nodes)
    expected = (stopped * nodes).sum() / stopped.sum()
    assert mean_place(torch.tensor(tau, dtype=F64)).item() == pytest.approx(expected.item(), abs=1e-12)


def test_gauss_and_legendre_integrate_polynomials_exactly() -> None:
    nodes, weights = gauss_legendre(3, 4)
    assert len(nodes) == len(weights) == 12
    for power in range(8):
        assert (weights * nodes**power).sum() == pytest.approx(1 / (power + 1), rel=1e-13)
