"""The hash grid: dense and hashed levels, inside the box, on its faces, outside, and nowhere."""

import math

import pytest
import torch
from torch import Tensor

from nerfloom.kernels.grids.hash_grid import hash_grid
from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from tests.kernels.triton.compared import compare

GRID = HashGridLayout.build(2, 4, 40, 8)  # a dense level and a hashed one


def encoded(positions: Tensor, table: Tensor) -> Tensor:
    return hash_grid(positions, table, GRID)


@pytest.mark.parametrize(("count", "features"), [(0, 2), (1, 1), (130, 2)])
def test_encoding(count: int, features: int) -> None:
    torch.manual_seed(0)
    given = {"positions": torch.rand(count, 3) * 1.2 - 0.1, "table": torch.randn(GRID.num_entries, features)}
    compare(encoded, given, "positions table")


def test_extremes() -> None:
    """Faces, corners, far outside, infinite and NaN."""
    places = [0.0, 1.0, -1e30, 1e30, 1 - 2**-24, 2**-149, math.inf, -math.inf]
    rows = [[a, b, 0.5] for a in places for b in places[:3]]
    torch.manual_seed(0)
    table = torch.randn(GRID.num_entries, 2)
    compare(encoded, {"positions": torch.tensor(rows), "table": table}, "positions table")
    compare(encoded, {"positions": torch.tensor([[math.nan, 0.3, 0.7], [0.3, 0.2, 0.1]]), "table": table})


def test_a_fine_level_reaches_no_entry_outside_its_table() -> None:
    layout = HashGridLayout.build(2, 2**19, 2**20, 5)
    torch.manual_seed(0)
    positions = torch.cat([torch.rand(20, 3), torch.ones(1, 3), torch.zeros(1, 3)])
    table = torch.randn(layout.num_entries, 2)
    # Positions in a cell have 4 bits at these resolutions, in either type, if they are rounded before.
    positions = (positions * 2**19).round() / 2**19
    compare(lambda positions, table: hash_grid(positions, table, layout), {"positions": positions, "table": table})


def test_other_numbers_of_features_are_the_references() -> None:
    given = {"positions": torch.rand(4, 3), "table": torch.rand(GRID.num_entries, 3)}
    compare(encoded, given, "table", expected="reference")
