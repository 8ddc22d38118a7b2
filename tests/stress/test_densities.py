"""From a network's output to a density, and an occupancy grid's cells from densities."""

import math
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.fields.encoded import EncodedField
from nerfloom.fields.tensor import DENSITY_SCALE, DENSITY_SHIFT, TensorField
from nerfloom.geometry.points import Points
from nerfloom.kernels.march.occupancy import refresh_occupancy
from nerfloom.kernels.math import MAX_LOG_DENSITY, split_density, truncated_exp
from nerfloom.samplers.occupancy import OccupancySampler
from tests.stress.backends import FEW, backends

BOX = torch.tensor([[-1.0] * 3, [1.0] * 3])
STEP = 0.01
"""Length of a step through the occupancy grid."""
CELLS = 2**12

each_type = pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])


def tolerance(dtype: torch.dtype) -> float:
    """Relative tolerance of a gradient that is rounded to a type."""
    return max(2 * torch.finfo(dtype).eps, 1e-6)


# -- heads --------------------------------------------------------------------------------------------------------


@pytest.mark.entry(1)
@each_type
@pytest.mark.parametrize("x", [-10.0, 0.0, 3.0, 11.0, 12.0, 89.0, 1e4])
@pytest.mark.parametrize("head", ["truncated_exp", "split_density"])
def test_an_exponential_density_is_float32_and_finite(head: str, x: float, dtype: torch.dtype) -> None:
    """exp overflows half precision at 11.1 and single precision at 88.8."""
    features = torch.tensor([[x, 0.5]], dtype=dtype, requires_grad=True)
    sigma = truncated_exp(features[:, 0]) if head == "truncated_exp" else split_density(features)[0]
    assert sigma.dtype == (torch.float64 if dtype == torch.float64 else torch.float32)
    truth = math.exp(min(features[0, 0].item(), MAX_LOG_DENSITY))
    assert sigma.item() == pytest.approx(truth, rel=1e-6)
    (slope,) = torch.autograd.grad(sigma.sum() * 2.0**-10, features)  # times exp(15) that fits into half precision
    assert slope.dtype == dtype
    assert slope[0].tolist() == [pytest.approx(truth * 2.0**-10, rel=tolerance(dtype), abs=1e-7), 0.0]


@pytest.mark.entry(1)
@FEW
@given(
    count=st.integers(0, 5),
    stride=st.integers(1, 3),
    uses=st.sampled_from(["density", "features", "both"]),
    dtype=st.sampled_from([torch.float32, torch.bfloat16]),
)
def test_density_and_features_split_as_by_slicing(count: int, stride: int, uses: str, dtype: torch.dtype) -> None:
    """Value and gradient, of rows that do not stand side by side, of none, and where only one part is used."""
    torch.manual_seed(0)
    rows = (torch.randn(count, 4 * stride) * 4).to(dtype)[:, ::stride]
    factors = torch.randn(count, 5, dtype=torch.float64)
    found = []
    for split in (split_density, lambda x: (torch.exp(x[:, 0]), x)):
        x = rows.detach() if split is split_density else rows.detach().double()
        x.requires_grad_()
        density, features = split(x)
        loss = factors.new_zeros(())
        if uses != "features":
            loss = loss + (density * factors[:, 0]).sum()
        if uses != "density":
            loss = loss + (features * factors[:, 1:]).sum()
        found.append((density.double(), torch.autograd.grad(loss, x)[0].double()))
    (density, slope), (true_density, true_slope) = found
    torch.testing.assert_close(density, true_density, rtol=1e-5, atol=0)
    torch.testing.assert_close(slope, true_slope, rtol=2 * torch.finfo(dtype).eps + 1e-5, atol=1e-5)


@pytest.mark.entry(1)
@each_type
@pytest.mark.parametrize("x", [-30.0, 10.0, 12.0, 89.0, 6e4])
def test_a_softplus_density_is_float32_and_finite(x: float, dtype: torch.dtype) -> None:
    components = torch.tensor([[x, 0.0]], dtype=dtype, requires_grad=True)
    field = SimpleNamespace(_unit=lambda positions: positions, density_factors=lambda unit: components)
    sigma, _ = TensorField.density(field, Points(torch.full((1, 3), 0.5)))  # type: ignore[arg-type]
    (slope,) = torch.autograd.grad(sigma.sum(), components)
    shifted = components[0, 0].item() + DENSITY_SHIFT
    truth = DENSITY_SCALE * (max(shifted, 0.0) + math.log1p(math.exp(-abs(shifted))))
    assert sigma.dtype == torch.float32
    assert sigma.item() == pytest.approx(truth, rel=1e-5)
    sigmoid = 1 / (1 + math.exp(-shifted))
    assert slope[0].tolist() == pytest.approx([DENSITY_SCALE * sigmoid] * 2, rel=tolerance(dtype) + 1e-5, abs=1e-7)


@pytest.mark.entry(1)
@backends()
@pytest.mark.parametrize("bfloat16", [False, True])
def test_a_field_whose_density_has_run_away_can_come_back(backend: str, bfloat16: bool) -> None:
    """Log-densities of 64,000: density is cut off, float32 under autocast, and its gradient says how to go down."""
    field = EncodedField(BOX, HashGrid(2, 2, 4, 8, 8), width=16)
    last = field.density_head[-1].weight
    with torch.no_grad():
        field.encoding.table.fill_(1.0)
        field.density_head[0].weight.fill_(1.0)
        last.fill_(1e3)
    with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
        sigma, _ = field.density(Points(torch.rand(7, 3) * 2 - 1))
    assert sigma.dtype == torch.float32
    assert sigma.tolist() == pytest.approx([math.exp(MAX_LOG_DENSITY)] * 7, rel=1e-6)
    sigma.sum().backward()
    for parameter in field.density_head.parameters():
        assert parameter.grad is not None
        assert bool(parameter.grad.isfinite().all())
    assert last.grad is not None
    assert bool((last.grad[0] > 0).all())


# -- the occupancy grid -------------------------------------------------------------------------------------------


def occupied_cells(density: torch.Tensor) -> torch.Tensor:
    """Cells that one refresh, without decay, finds occupied."""
    occupied = torch.zeros(len(density), dtype=torch.bool)
    refresh_occupancy(density, occupied, 1.0, STEP, 0.01)
    return occupied


@pytest.mark.entry(8)
@backends()
@pytest.mark.parametrize("share", [1.0, 0.5])
def test_cells_of_any_density(backend: str, share: float) -> None:
    """Densities go from 0 to infinity, which marks unknown cells; the truth is opacity in float64."""
    density = torch.zeros(CELLS)
    filled = int(CELLS * share)
    density[:filled] = torch.logspace(-30, 30, filled)
    density[:16] = torch.inf
    alpha = -torch.expm1(-density.double() * STEP)
    least = min(0.01, alpha.mean().item())
    clear = (alpha / least - 1).abs() > 1e-3
    assert torch.equal(occupied_cells(density)[clear], (alpha >= least)[clear])


@pytest.mark.entry(11)
@backends()
def test_thin_cells_are_told_from_empty_ones(backend: str) -> None:
    """A step through a cell stops 1e-9 of the light, or none of it: the mean lies between the two."""
    density = torch.zeros(CELLS)
    density[::2] = 1e-9 / STEP
    assert torch.equal(occupied_cells(density), density > 0)


@pytest.mark.entry(5)
@backends()
@pytest.mark.parametrize("opacity", [1e-9, 1e-7, 1e-4, 3e-4, 1e-3, 7e-3])
def test_cells_that_are_all_alike_are_not_empty(backend: str, opacity: float) -> None:
    """Thin fog everywhere: its mean, rounded, may exceed every one of the equal opacities."""
    assert bool(occupied_cells(torch.full((CELLS,), opacity / STEP)).all())


@pytest.mark.entry(5)
@backends()
def test_a_nan_cell_leaves_the_others_alone(backend: str) -> None:
    density = torch.zeros(CELLS)
    density[::2] = 1e-3 / STEP
    density[1] = math.nan
    assert bool(occupied_cells(density)[::2].all())


@pytest.mark.entry(5)
@backends()
def test_a_nan_cell_is_marched(backend: str) -> None:
    density = torch.full((CELLS,), 1.0 / STEP)
    density[7] = math.nan
    assert bool(occupied_cells(density)[7])


@pytest.mark.entry(5)
@backends()
def test_a_cell_that_was_nan_once_recovers(backend: str) -> None:
    """NaN is not a maximum that stays: the next visit replaces it."""
    sampler = OccupancySampler(BOX, resolution=8, num_steps=32)
    sampler.density_grid.fill_(math.nan)
    torch.manual_seed(0)
    sampler.update(8, lambda points: (torch.full((len(points),), 5.0), points.positions))
    visited = ~sampler.density_grid.isnan()
    assert 0 < int(visited.sum()) < 8**3
    assert bool((sampler.density_grid[visited] == 5).all())
    assert bool(sampler.occupied[visited].all())
