"""Harmonics, frequencies and contraction."""

import math

import pytest
import torch

from nerfloom.kernels.encodings.contraction import contract_to_unit
from nerfloom.kernels.encodings.frequency import frequency_encoding
from nerfloom.kernels.encodings.integrated_directional import directional_encoding
from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics
from tests.kernels.triton.compared import compare

BOX = torch.tensor([[-1.0, -1.5, -1.0], [1.0, 1.0, 2.0]])


@pytest.mark.parametrize("levels", [1, 2, 3, 4])
@pytest.mark.parametrize("count", [0, 1, 300])
def test_harmonics(levels: int, count: int) -> None:
    torch.manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
    directions[: min(count, 1)] = torch.tensor([0.0, 0.0, -1.0])
    compare(lambda directions: spherical_harmonics(directions, levels), {"directions": directions})


def test_harmonics_leave_gradients_to_the_reference() -> None:
    compare(spherical_harmonics, {"directions": torch.rand(3, 3)}, "directions", expected="reference")


@pytest.mark.parametrize(("bands", "count"), [(1, 1), (2, 300), (3, 0), (4, 17), (5, 300)])
def test_directional_encoding(bands: int, count: int) -> None:
    """Directions include poles and the equator, and roughness goes from none to a matt surface's."""
    torch.manual_seed(bands)
    directions = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
    directions[: min(count, 4)] = torch.tensor([[0.0, 0, -1], [0, 0, 1], [1, 0, 0], [0, -1, 0]])[: min(count, 4)]
    roughness = torch.tensor([0.0, 1e-4, 1e-3, 1e-2, 0.1, 1, 10]).repeat(count // 7 + 1)[:count]
    given = {"directions": directions, "roughness": roughness}
    compare(lambda directions, roughness: directional_encoding(directions, roughness, bands), given, " ".join(given))


@pytest.mark.parametrize("include_input", [True, False])
@pytest.mark.parametrize(
    ("shape", "frequencies"), [((0, 3), 4), ((1, 1), 1), ((5, 7, 3), 6), ((90, 4), 9), ((3, 2), 0)]
)
def test_frequencies(shape: tuple[int, ...], frequencies: int, include_input: bool) -> None:
    torch.manual_seed(0)
    # Few bits, so that x times 2^k is the same angle in both types.
    x = (torch.randn(shape) * 256).round() / 256
    compare(lambda x: frequency_encoding(x, frequencies, include_input), {"x": x}, "x" if shape[0] else "")


def test_extremes_of_frequencies() -> None:
    x = torch.tensor([[0.0, 8191.0, -100.5], [1e-30, math.inf, math.nan]])
    compare(lambda x: frequency_encoding(x, 3), {"x": x})
    compare(lambda x: frequency_encoding(x, 31), {"x": torch.tensor([[2.0**-20, -(2.0**-25)]])})


@pytest.mark.parametrize("count", [0, 1, 300])
def test_contraction(count: int) -> None:
    torch.manual_seed(0)
    compare(lambda x, box: contract_to_unit(x, box), {"x": 5 * torch.randn(count, 3), "box": BOX}, "x")


def test_extremes_of_contraction() -> None:
    """The centre, the surface, and places so far away that their squares, or themselves, are not finite."""
    rows = [[0.0, -0.25, 0.5], [1.0, -0.25, 0.5], [1e13, 2e12, 0.0], [1e30, -1e30, 3.0], [3e38, 3e38, -3e38]]
    compare(lambda x, box: contract_to_unit(x, box), {"x": torch.tensor(rows), "box": BOX}, "x")
    odd = torch.tensor([[math.inf, 0.0, 0.0], [-math.inf, math.inf, 1.0], [math.nan, 0.0, 1.0]])
    compare(lambda x, box: contract_to_unit(x, box), {"x": odd, "box": BOX})
