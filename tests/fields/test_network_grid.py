"""A grid of small networks: which network has a position, where in its cell, and that no other network matters."""

import math

import pytest
import torch

from nerfloom.base.errors import ConfigError
from nerfloom.fields.network_grid import GroupedMLP, NetworkGrid, cells_along
from nerfloom.geometry.points import Points
from nerfloom.kernels.encodings.frequency import frequency_encoding_reference
from nerfloom.kernels.networks.grouped import layers_of
from nerfloom.kernels.networks.mlp import mlp_reference
from nerfloom.training.optim import Adam

BOX = torch.tensor([[-1.0, -1.0, 0.0], [1.0, 0.0, 4.0]])


def grid(**settings: int) -> NetworkGrid:
    torch.manual_seed(0)
    return NetworkGrid(BOX, **{"resolution": 8, **settings})


def test_cells_are_about_cubes() -> None:
    assert cells_along(BOX, 16) == (8, 4, 16)
    assert cells_along(BOX, 1) == (1, 1, 1)
    assert grid().cells == (4, 2, 8)
    assert NetworkGrid(BOX, 2, unbounded=True).cells == (2, 2, 2)


def test_positions_and_their_places_in_cells() -> None:
    positions = torch.tensor([
        [-1.0, -1.0, 0.0],  # a corner
        [0.25, -0.25, 1.75],  # the middle of cell (2, 1, 3)
        [0.0, -0.5, 0.5],  # the lower corner of cell (2, 1, 1)
        [1.0, 0.0, 4.0],  # the far corner belongs to the last cell
        [3.0, -0.75, -1.0],  # outside
    ])  # fmt: skip
    owners, places = grid().located(positions)
    cells = [(0, 0, 0), (2, 1, 3), (2, 1, 1), (3, 1, 7), (3, 0, 0)]
    assert owners.tolist() == [(x * 2 + y) * 8 + z for x, y, z in cells]
    expected = torch.tensor([[-1.0] * 3, [0.0] * 3, [-1.0] * 3, [1.0] * 3, [9.0, 0.0, -5.0]])
    torch.testing.assert_close(places, expected, atol=1e-5, rtol=0)


def test_positions_that_are_not_finite_stay_so() -> None:
    owners, places = grid().located(torch.tensor([[torch.nan, 0, 0], [torch.inf, -torch.inf, 1.0]]))
    assert bool(((owners >= 0) & (owners < 64)).all())
    assert bool(places[0, 0].isnan())
    assert not bool(places[1].isfinite().all())


def test_the_papers_parameter_count() -> None:
    """63 inputs, two layers of 32, density and 32 features; those and 27 of the direction, 32, and the colour."""
    each = (63 + 1) * 32 + (32 + 1) * 32 + (32 + 1) * 33 + (32 + 27 + 1) * 32 + (32 + 1) * 3
    assert sum(p.numel() for p in grid().parameters()) == 64 * each


def test_it_is_what_the_network_of_the_cell_computes() -> None:
    field = grid(width=8, position_frequencies=3, direction_frequencies=2)
    with torch.no_grad():
        for parameter in field.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))  # no two networks are the same
    positions = torch.lerp(BOX[0], BOX[1], torch.rand(30, 3))
    directions = torch.nn.functional.normalize(torch.randn(30, 3), dim=-1)
    sigma, features = field.density(Points(positions))
    rgb = field.color(features, directions)
    for index in range(30):
        scaled = (positions[index] - BOX[0]) * 2  # cells have edges of 0.5
        cell = scaled.floor()
        owner = int((cell[0] * 2 + cell[1]) * 8 + cell[2])

        def alone(network: GroupedMLP, *inputs: torch.Tensor, owner: int = owner) -> torch.Tensor:
            layers = layers_of(network.table, network.widths)
            weights, biases = ([values[owner] for values in part] for part in layers)
            return mlp_reference(inputs, weights, network.activation, biases)

        hidden = alone(field.trunk, frequency_encoding_reference(2 * (scaled - cell)[None] - 1, 3))
        color = alone(field.color_head, hidden[:, 1:], frequency_encoding_reference(directions[index][None], 2))
        assert float(sigma[index]) == pytest.approx(math.exp(float(hidden[0, 0])), rel=1e-4)
        torch.testing.assert_close(rgb[index], color[0], rtol=1e-4, atol=1e-5)


def test_all_networks_start_the_same_and_learn_apart() -> None:
    field = grid(position_frequencies=2)
    networks, positions = field.trunk.table, torch.tensor([[-0.9, -0.9, 0.1]])
    assert torch.equal(networks[0].expand_as(networks), networks)
    optimizer = Adam(
        [{"params": [networks], "sparse": field.trunk.optimised.sparse}],
        {networks: field.trunk.deferred}, 0.1, (0.9, 0.99), 1e-8,
    )  # fmt: skip
    before = networks.detach().clone()
    field.density(Points(positions))[0].sum().backward()
    optimizer.step()
    moved = (networks != before).any(-1)
    assert moved.nonzero()[:, 0].tolist() == [int(field.located(positions)[0])]
    assert optimizer.entries == (1, 64)


def test_the_length_of_networks_that_have_rows() -> None:
    """The norms of weights and biases, layer by layer, and their gradient, which only these networks have."""
    torch.manual_seed(0)
    networks = GroupedMLP(5, 3, 4, 2)
    with torch.no_grad():
        networks.table.normal_()
    exact = networks.table.detach().double().requires_grad_()
    parts = exact[[1, 3]].split([12, 4, 8, 2], dim=1)
    true = sum((part.square().sum().sqrt() for part in parts), torch.zeros((), dtype=torch.float64))
    found = networks.length(torch.tensor([3, 1, 1, 3, 3]))
    found.backward()
    true.backward()
    assert networks.deferred is not None
    grad = networks.deferred.summed(networks.table.detach()) if networks.deferred.pending else networks.table.grad
    torch.testing.assert_close(found, true.float())
    torch.testing.assert_close(grad, exact.grad.float())


def test_features_name_their_networks() -> None:
    field, positions = grid(), torch.lerp(BOX[0], BOX[1], torch.rand(50, 3))
    features = field.density(Points(positions))[1]
    assert torch.equal(field.owners(features), field.located(positions)[0])


def test_kernels_are_for_networks_up_to_their_limits() -> None:
    assert grid().runs_on_kernels
    assert grid(depth=7, width=8).runs_on_kernels
    assert not grid(depth=8, width=8).runs_on_kernels
    assert not grid(width=384, resolution=1).runs_on_kernels


def test_all_of_space_is_in_the_contracted_grid() -> None:
    field = NetworkGrid(BOX, 4, unbounded=True)
    owners, places = field.located(torch.tensor([[0.0, -0.5, 2.0], [1e6, 0.0, 0.0], [-40.0, 3.0, 900.0]]))
    assert bool((places.abs() <= 1 + 1e-4).all())
    assert len(owners.unique()) == 3


def test_sizes_that_no_machine_has() -> None:
    with pytest.raises(ConfigError, match="GiB for the networks of a grid"):
        GroupedMLP(10**9, 64, 1024, 3)
    with pytest.raises(ConfigError, match="1 feature or more"):
        GroupedMLP(3, 64, 0, 3)
