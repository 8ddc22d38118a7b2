"""The network of IDR, NeuS and VolSDF: how it starts, and its gradients, against a ball and finite differences."""

import pytest
import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.fields import distance
from nerfloom.fields.distance import NetworkDistance, Shape
from nerfloom.kernels.surfaces.opacity import laplace_density, surface_opacity
from nerfloom.kernels.surfaces.samples import Intervals

BOX = torch.tensor([[-1.0, -2.0, -2.0], [3.0, 2.0, 2.0]])
"""A cube around (1, 0, 0) with an edge of 4."""


def network(width: int = 48, frequencies: int = 2) -> NetworkDistance:
    torch.manual_seed(0)
    return NetworkDistance(BOX, 0.5, width, num_frequencies=frequencies).double()


def places(count: int) -> Tensor:
    torch.manual_seed(1)
    return torch.lerp(BOX[0], BOX[1], torch.rand(count, 3))


def test_it_starts_as_a_ball() -> None:
    """Its radius is half of the box's half edge, up to some per cent of it."""
    torch.manual_seed(0)
    found: Shape = NetworkDistance(BOX, 0.5)(places(1_000))
    offsets = places(1_000) - BOX.mean(0)
    error = (found.distances - (offsets.norm(dim=-1) - 1.0)).abs()
    slopes, ahead = found.gradients.norm(dim=-1), torch.nn.functional.normalize(offsets, dim=-1)
    print(float(error.mean()), float(error.max()), float(slopes.mean()), float(slopes.std()))
    assert error.mean() < 0.06
    assert error.max() < 0.5  # in the corners of the box
    assert (slopes - 1).abs().mean() < 0.15
    assert (found.gradients * ahead).sum(-1).mean() > 0.9
    surface: Shape = NetworkDistance(BOX, 0.5)(BOX.mean(0) + ahead)
    assert surface.distances.abs().mean() < 0.06
    assert found.features.shape == (1_000, 256)


def test_its_gradient_is_that_of_finite_differences() -> None:
    net, where, step = network(), places(40).double(), 1e-6
    found: Shape = net(where)
    for axis in range(3):
        by = torch.zeros(3, dtype=torch.float64)
        by[axis] = step
        difference = (net(where + by).distances - net(where - by).distances) / (2 * step)
        torch.testing.assert_close(found.gradients[:, axis], difference, atol=1e-5, rtol=1e-5)


def test_gradients_of_its_gradient_are_those_of_finite_differences() -> None:
    """The loss is on distance, gradient and features: along a random direction of all parameters, and by positions."""
    net, where = network(), places(40).double().requires_grad_()
    weights = torch.randn(40, 48, dtype=torch.float64)

    def loss(positions: Tensor) -> Tensor:
        shape: Shape = net(positions)
        eikonal = (shape.gradients.norm(dim=-1) - 1).square().mean()
        return eikonal + shape.distances.square().mean() + (weights * shape.features).mean()

    parameters = list(net.parameters())
    *found, of_places = torch.autograd.grad(loss(where), [*parameters, where])
    ways, step = [torch.randn_like(parameter) for parameter in parameters], 1e-7
    expected = sum(float((grad * way).sum()) for grad, way in zip(found, ways, strict=True))
    values = []
    with torch.no_grad():
        for sign in (1, -2):
            for parameter, way in zip(parameters, ways, strict=True):
                parameter += sign * step * way
            values.append(float(loss(where)))
        for parameter, way in zip(parameters, ways, strict=True):
            parameter += step * way
        moved = [float(loss(where + sign * step * weights[:, :3])) for sign in (1, -1)]
    assert (values[0] - values[1]) / (2 * step) == pytest.approx(expected, rel=1e-4, abs=1e-5)
    along = float((of_places * weights[:, :3]).sum())
    assert (moved[0] - moved[1]) / (2 * step) == pytest.approx(along, rel=1e-4, abs=1e-5)


def test_pictures_are_of_the_same_distance_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    net, where = network(), places(20).double()
    whole: Shape = net(where)
    monkeypatch.setattr(distance, "AT_ONCE", 7)
    with torch.no_grad():
        parts: Shape = net(where)
        nothing: Shape = net(where[:0])
    for one, other in zip(whole, parts, strict=True):
        torch.testing.assert_close(other, one.detach())
        assert not other.requires_grad
    assert [tuple(values.shape) for values in nothing] == [(0,), (0, 3), (0, 48)]


def test_samples_stop_light_by_the_papers_formulas() -> None:
    net, where = network(), places(20).double()
    sharpness, lengths = torch.tensor(20.0, dtype=torch.float64), torch.full((20,), 0.1, dtype=torch.float64)
    directions = torch.nn.functional.normalize(torch.randn(20, 3, dtype=torch.float64), dim=-1)
    shape: Shape = net(where)
    density, features = net.samples(where, sharpness)
    torch.testing.assert_close(density, laplace_density(shape.distances, 1 / sharpness))
    torch.testing.assert_close(features[:, :3], shape.gradients)
    torch.testing.assert_close(features[:, 3:6], (where - BOX.mean(0)) / 2)
    torch.testing.assert_close(features[:, 6:], shape.features)
    opacity, _ = net.samples(where, sharpness, Intervals(directions, lengths, 0.5))
    cosines = (shape.gradients * directions).sum(-1)
    torch.testing.assert_close(opacity, surface_opacity(shape.distances, cosines, lengths, sharpness, 0.5))


def test_a_network_narrower_than_its_input_is_refused() -> None:
    with pytest.raises(ConfigError, match="--hidden-width is 39; it must be more than the 39"):
        NetworkDistance(BOX, width=39)
