"""Planes and lines: K-Planes' groups of all pairs of 3 or 4 axes, TensoRF's planes with lines, and its lines."""

import math

import pytest
import torch

from nerfloom.kernels.grids.planes import planes
from nerfloom.kernels.grids.planes_layout import PlanesLayout
from tests.kernels.triton.compared import compare

LAYOUTS = {
    "static": PlanesLayout.build(((5, 6, 7), (2, 9, 10))),
    "moving": PlanesLayout.build(((5, 6, 7, 3),)),
    "vm": PlanesLayout.build(((5, 6, 7),) * 3, (((0, 1), (2,)), ((0, 2), (1,)), ((1, 2), (0,)))),
    "cp": PlanesLayout.build(((5, 6, 7),), (((0,), (1,), (2,)),)),
}


@pytest.mark.parametrize(("name", "count", "features"), [
    ("static", 0, 4), ("static", 9, 6), ("moving", 3, 2), ("cp", 1, 1),
])  # fmt: skip
def test_features(name: str, count: int, features: int) -> None:
    torch.manual_seed(0)
    layout = LAYOUTS[name]
    given = {"positions": torch.rand(count, layout.dims) * 1.2 - 0.1, "table": torch.rand(layout.num_entries, features)}
    compare(lambda positions, table: planes(positions, table, layout), given, "positions table")


def test_extremes() -> None:
    """Positions are on faces, corners, far outside and NaN; zeros in the table lose no gradient."""
    torch.manual_seed(0)
    layout = LAYOUTS["vm"]
    places = [0.0, 1.0, -1e30, math.inf, 1 - 2**-24]
    positions = torch.tensor([[a, b, 0.5] for a in places for b in places[:3]])
    table = torch.rand(layout.num_entries, 2)
    table[::3] = 0
    run = lambda positions, table: planes(positions, table, layout)  # noqa: E731
    compare(run, {"positions": positions, "table": table}, "positions table")
    compare(run, {"positions": torch.tensor([[math.nan, 0.3, 0.7], [0.3, 0.2, 0.1]]), "table": table})
