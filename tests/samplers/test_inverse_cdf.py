"""Inverse-transform sampling against the distribution it claims to draw from."""

import numpy as np
import pytest
import torch
from scipy import stats

from nerfloom.kernels.histograms.inverse_cdf import inverse_cdf, uniform_variates

EDGES = torch.tensor([[0.0, 0.5, 0.7, 2.0, 2.5, 4.0]], dtype=torch.float64)
WEIGHTS = torch.tensor([[1.0, 0.0, 3.0, 0.5, 0.1]], dtype=torch.float64)


def test_a_million_draws_follow_the_density() -> None:
    u = torch.rand(1, 10**6, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    drawn = inverse_cdf(EDGES, WEIGHTS, u, padding=0.0)[0].numpy()
    share = (WEIGHTS / WEIGHTS.sum())[0].numpy()
    cdf = np.concatenate([[0], share.cumsum()])
    distance = stats.kstest(drawn, lambda x: np.interp(x, EDGES[0].numpy(), cdf)).statistic
    counts = np.histogram(drawn, EDGES[0].numpy())[0]
    off = np.abs(counts / 1e6 - share).max()
    print(f"inverse CDF, 10^6 draws: largest CDF error {distance:.1e}, shares off by {off:.1e}")
    assert distance < 1.63e-3  # 1 % level of Kolmogorov and Smirnov: 1.63 / sqrt(n)
    assert counts[1] == 0
    assert stats.chisquare(counts[share > 0], share[share > 0] * 10**6).pvalue > 1e-3


def test_even_spacing_reproduces_quantiles() -> None:
    """The k-th of S evenly spaced samples is the (k + 0.5) / S quantile, with one bin per weight."""
    u = uniform_variates(1, 8, False, torch.device("cpu")).double()
    drawn = inverse_cdf(torch.tensor([[0.0, 1.0, 3.0]]).double(), torch.tensor([[1.0, 1.0]]).double(), u, 0.0)
    expected = [0.125, 0.375, 0.625, 0.875, 1.25, 1.75, 2.25, 2.75]
    torch.testing.assert_close(drawn[0], torch.tensor(expected, dtype=torch.float64))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_all_zero_weights_are_sampled_evenly(dtype: torch.dtype) -> None:
    edges = torch.linspace(1, 5, 9, dtype=dtype)[None]
    u = torch.linspace(0, 1, 33, dtype=dtype)[None]
    torch.testing.assert_close(inverse_cdf(edges, torch.zeros(1, 8, dtype=dtype), u), 1 + 4 * u)


def test_ends_zero_width_bins_and_one_bin() -> None:
    u = torch.tensor([[0.0, 0.3, 1.0]])
    assert inverse_cdf(torch.tensor([[2.0, 3.0]]), torch.tensor([[5.0]]), u)[0].tolist() == pytest.approx([2, 2.3, 3])
    drawn = inverse_cdf(torch.tensor([[0.0, 1.0, 1.0, 2.0]]), torch.tensor([[1.0, 7.0, 1.0]]), u)
    assert bool(torch.isfinite(drawn).all())
    assert drawn[0, 1].item() == 1.0  # the zero-width bin holds most of the weight


def test_results_stay_inside_and_in_order() -> None:
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(200, 64, generator=generator) ** 20  # float32, spanning many magnitudes
    edges = torch.rand(200, 65, generator=generator).cumsum(-1)
    u = torch.rand(200, 128, generator=generator).sort(-1).values
    u[:, -1] = 1.0
    drawn = inverse_cdf(edges, weights, u)
    assert bool((drawn >= edges[:, :1]).all())
    assert bool((drawn <= edges[:, -1:]).all())
    assert bool((drawn.diff(dim=-1) >= 0).all())


def test_variates() -> None:
    torch.manual_seed(0)
    u = uniform_variates(100, 1000, True, torch.device("cpu"))
    assert stats.kstest(u.flatten().numpy(), "uniform").pvalue > 1e-3
