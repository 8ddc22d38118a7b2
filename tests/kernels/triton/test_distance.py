"""A distance's network: values, and the gradients of outputs and of their gradient, inside the box and outside."""

import pytest
import torch
from torch import Tensor

from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from nerfloom.kernels.surfaces.distance import distance_network
from tests.kernels.triton.compared import compare

GRID = HashGridLayout.build(2, 4, 40, 8)  # a dense level and a hashed one


def found(positions: Tensor, table: Tensor, first: Tensor, second: Tensor) -> Tensor:
    return distance_network(positions, table, first, second, GRID)


@pytest.mark.parametrize(("count", "features"), [(0, 2), (1, 1), (130, 2)])
def test_values_and_second_derivatives(count: int, features: int) -> None:
    torch.manual_seed(0)
    given = {
        "positions": torch.rand(count, 3) * 1.2 - 0.1,
        "table": torch.randn(GRID.num_entries, features),
        "first": torch.randn(20, 2 * features),
        "second": torch.randn(5, 20),
    }
    compare(found, given, "table first second")


def test_positions_with_a_gradient_take_the_reference() -> None:
    torch.manual_seed(0)
    given = {
        "positions": torch.rand(9, 3),
        "table": torch.randn(GRID.num_entries, 2),
        "first": torch.randn(6, 4),
        "second": torch.randn(2, 6),
    }
    compare(found, given, "positions table", expected="reference")
