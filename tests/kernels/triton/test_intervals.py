"""Histograms along rays."""

import math

import pytest
import torch
from torch import Tensor

from nerfloom.kernels.histograms.intervals import interval_weights, proposal_excess, resample
from tests.kernels.triton.compared import compare


def edges(rays: int, bins: int) -> Tensor:
    return torch.rand(rays, bins + 1).sort(-1).values


@pytest.mark.parametrize(("rays", "bins"), [(0, 5), (1, 1), (2, 64), (3, 130)])
def test_weights(rays: int, bins: int) -> None:
    torch.manual_seed(0)
    given = {"sigma": torch.rand(rays, bins), "t": edges(rays, bins)}
    given["sigma"][:1] *= 1e4
    given["sigma"][-1:] *= 1e-6
    compare(interval_weights, given, "sigma")


def test_extremes_of_weights() -> None:
    inf = math.inf
    sigma = torch.tensor([[0.0, inf, 1.0, inf], [1.0, 0.0, 2.0, 0.0], [1.0, math.nan, 2.0, 1.0]])
    t = torch.tensor([[0.0, 1.0, 2.0, 2.0, 3.0], [0.0, 1.0, 1.0, 2.0, inf], [0.0, 1.0, 2.0, 3.0, 4.0]])
    compare(interval_weights, {"sigma": sigma[:2], "t": t[:2]}, "sigma")
    compare(interval_weights, {"sigma": sigma, "t": t})


@pytest.mark.parametrize(("rays", "bins", "count"), [(0, 4, 3), (1, 1, 1), (3, 64, 65), (2, 130, 40)])
@pytest.mark.parametrize(("power", "padding"), [(1.0, 0.01), (0.5, 0.0)])
def test_resampling(rays: int, bins: int, count: int, power: float, padding: float) -> None:
    torch.manual_seed(0)
    given = {"edges": edges(rays, bins), "weights": torch.rand(rays, bins) ** 4, "shift": torch.rand(rays)}
    compare(lambda edges, weights, shift: resample(edges, weights, shift, count, power, padding), given)

    def on_device(edges: Tensor, weights: Tensor, shift: Tensor) -> Tensor:
        return resample(edges, weights, shift, count, torch.full((), power, device=edges.device), padding)

    compare(on_device, given)


def test_extremes_of_resampling() -> None:
    """No weight at all, all in one bin, bins without a width, and NaN."""
    weights = torch.tensor([[0.0, 0, 0, 0], [0, 1e-30, 0, 0], [0, 1, 1e-9, 0], [1, 0, 0, 1e30]])
    t = torch.tensor([0.0, 1.0, 1.0, 2.0, 3.0]).repeat(4, 1)
    given = {"edges": t, "weights": weights, "shift": torch.tensor([0.0, 0.5, 0.25, 0.75])}
    compare(lambda edges, weights, shift: resample(edges, weights, shift, 5, 1.0, 0.0), given)
    given["weights"] = torch.full((4, 4), math.nan)
    with torch.no_grad():
        assert resample(*(given[name] for name in ("edges", "weights", "shift")), 3, 1.0, 0.0).isnan().all()


@pytest.mark.parametrize(("rays", "bins", "proposed"), [(0, 3, 2), (1, 1, 1), (2, 65, 40), (1, 30, 130)])
def test_excess(rays: int, bins: int, proposed: int) -> None:
    torch.manual_seed(0)
    given = {
        "edges": edges(rays, bins), "weights": torch.rand(rays, bins) / bins, "proposed": edges(rays, proposed),
        "proposed_weights": torch.rand(rays, proposed) / proposed / 2,
    }  # fmt: skip
    compare(proposal_excess, given, "proposed_weights")


def test_extremes_of_excess() -> None:
    """Nothing proposed, nothing to be bounded, shared edges, and a proposal elsewhere."""
    t = torch.tensor([0.0, 1.0, 1.0, 2.0]).repeat(4, 1)
    given = {
        "edges": t, "weights": torch.tensor([[0.5, 0.0, 0.5], [0.0, 0, 0], [1.0, 1e-30, 0], [0.2, 0.3, 0.5]]),
        "proposed": torch.stack([t[0], t[0], t[0], t[0] + 9]),
        "proposed_weights": torch.tensor([[0.0, 0, 0], [1.0, 1, 1], [0.1, 0.2, 0.3], [1.0, 1, 1]]),
    }  # fmt: skip
    compare(proposal_excess, given, "proposed_weights")
