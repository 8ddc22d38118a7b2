"""Thinned gradients: their mean over draws, and the same bits from kernels that leave out zeros."""

import pytest
import torch
from torch import Tensor

from nerfloom.kernels.compositing.thinning import thinned
from nerfloom.kernels.grids.hash_grid import hash_grid
from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from nerfloom.kernels.grids.planes import planes
from nerfloom.kernels.grids.planes_layout import PlanesLayout

COPIES = 4_000


def gradients(floor: float, count: int, copies: int = 1) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Density (N,), gradients of it and of the colour (copies, N, 4), true and found, with sizes over five decades."""
    generator = torch.Generator().manual_seed(0)
    sigma = torch.rand(count, generator=generator) * 3
    true = torch.randn(count, 4, generator=generator) * 10 ** -(5 * torch.rand(count, 1, generator=generator))
    density, rgb = sigma.repeat(copies).requires_grad_(), torch.zeros(copies * count, 3, requires_grad=True)
    values = thinned(density, rgb, floor)
    torch.testing.assert_close(values, (density, rgb), rtol=0, atol=0)
    torch.autograd.backward(values, (true[:, 0].repeat(copies), true[:, 1:].repeat(copies, 1)))
    assert density.grad is not None
    assert rgb.grad is not None
    found = torch.cat([density.grad[:, None], rgb.grad], 1).view(copies, count, 4)
    size = (true[:, 0] * sigma).abs() + true[:, 1:].abs().sum(1)
    return sigma, true, found, size


@pytest.mark.parametrize("floor", [0.25, 1.0, 4.0])
def test_the_mean_over_draws_is_the_gradient(floor: float) -> None:
    """Each copy of the samples is a draw. The variance of a roulette is g^2 (1 / p - 1)."""
    torch.manual_seed(1)
    _, true, found, size = gradients(floor, 100, COPIES)
    chance = (size / (floor * size.mean())).clamp(max=1)
    deviation = true.abs() * ((1 / chance - 1) / COPIES).sqrt()[:, None]
    probable = chance * COPIES > 20  # of rarer ones the mean of so few draws is not normal
    assert int(probable.sum()) > 40
    off = ((found.mean(0) - true).abs() / (deviation + 1e-6 * true.abs()))[probable]
    assert float(off.max()) < 5
    share = (found != 0).any(-1).float().mean(0)
    assert float(((share - chance).abs() / (chance * (1 - chance) / COPIES + 1e-9).sqrt()).max()) < 6


def test_large_gradients_are_kept_to_the_bit_and_some_small_ones_left_out() -> None:
    torch.manual_seed(2)
    _, true, found, size = gradients(0.5, 300)
    large = size >= 0.5 * size.mean()
    torch.testing.assert_close(found[0][large], true[large], rtol=0, atol=0)
    left_out = (found[0] == 0).all(-1)
    assert bool(left_out.any())
    assert bool((~left_out & ~large).any())


def test_zero_stays_zero_and_nan_is_seen() -> None:
    torch.manual_seed(3)
    for given in (0.0, torch.nan):
        sigma, rgb = torch.ones(9, requires_grad=True), torch.ones(9, 3, requires_grad=True)
        weights = torch.zeros(9)
        weights[4] = given
        density, colors = thinned(sigma, rgb, 0.5)
        ((density + colors.sum(1)) * weights).sum().backward()
        assert sigma.grad is not None
        assert rgb.grad is not None
        torch.testing.assert_close(sigma.grad, weights, rtol=0, atol=0, equal_nan=True)
        torch.testing.assert_close(rgb.grad[:, 0], weights, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("lookup", ["hash grid", "planes"])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_tables_skip_samples_without_gradient_to_the_same_bits(lookup: str, share: float) -> None:
    torch.manual_seed(4)
    if lookup == "hash grid":
        layout = HashGridLayout.build(4, 4, 40, 9)
        table, encode = torch.randn(layout.num_entries, 2), lambda x, t: hash_grid(x, t, layout)
    else:
        grid = PlanesLayout.build(((8, 9, 10), (16, 5, 32)))
        table, encode = torch.randn(grid.num_entries, 16), lambda x, t: planes(x, t, grid)
    positions, live = torch.rand(333, 3), torch.rand(333) < share
    incoming = torch.randn_like(encode(positions, table)) * live[:, None]
    table.requires_grad_()
    (whole,) = torch.autograd.grad(encode(positions, table), table, incoming)
    (compact,) = torch.autograd.grad(encode(positions[live], table), table, incoming[live])
    torch.testing.assert_close(whole, compact, rtol=0, atol=0)
    assert bool((whole != 0).any()) == (share > 0)
