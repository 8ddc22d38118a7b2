"""Many small networks at once: each row is what its own network computes, in value and gradient."""

from itertools import pairwise

import pytest
import torch
from torch import Tensor

from nerfloom.kernels.networks.grouped import MAX_CHUNK, MIN_CHUNK, chunks_of, grouped_mlp
from nerfloom.kernels.networks.mlp import Activation, mlp_reference

NETWORKS, WIDTHS = 7, (5, 6, 4, 3)


def networks(seed: int = 0) -> tuple[list[Tensor], list[Tensor]]:
    """Weights and biases of NETWORKS random networks, in float64."""
    torch.manual_seed(seed)
    weights = [torch.randn(NETWORKS, after, before, dtype=torch.float64) for before, after in pairwise(WIDTHS)]
    return weights, [torch.randn(NETWORKS, after, dtype=torch.float64) for after in WIDTHS[1:]]


def one_by_one(
    inputs: list[Tensor], owners: Tensor, weights: list[Tensor], biases: list[Tensor], activation: Activation
) -> Tensor:
    """A loop over the networks, and in it over nothing."""
    x = torch.cat(inputs, dim=-1)
    out = x.new_zeros(len(x), WIDTHS[-1])
    for network in range(NETWORKS):
        rows = (owners == network).nonzero()[:, 0]
        own = [weight[network] for weight in weights]
        values = mlp_reference([x[rows]], own, activation, [bias[network] for bias in biases])
        out = out.index_copy(0, rows, values)
    return out


OWNERS = {
    "mixed": torch.tensor([3, 0, 3, 6, 0, 3, 5, 3, 3, 1, 6, 0, 3]),  # networks 2 and 4 have no row
    "one network": torch.full((40,), 4),
    "one row": torch.tensor([6]),
    "none": torch.zeros(0, dtype=torch.int64),
    "uneven": torch.cat([torch.full((900,), 2), torch.arange(7), torch.full((30,), 5)]),
}


@pytest.mark.parametrize("activation", ["none", "relu", "sigmoid"])
@pytest.mark.parametrize("kind", OWNERS)
def test_each_row_is_that_of_its_network(kind: str, activation: Activation) -> None:
    owners, (weights, biases) = OWNERS[kind], networks()
    inputs = [torch.randn(len(owners), width, dtype=torch.float64) for width in (2, 3)]
    direction = torch.randn(len(owners), WIDTHS[-1], dtype=torch.float64)
    found = []
    for run in (grouped_mlp, one_by_one):
        leaves = [values.clone().requires_grad_() for values in (*inputs, *weights, *biases)]
        out = run(leaves[:2], owners, leaves[2:5], leaves[5:], activation)
        found.append([out, *torch.autograd.grad((out * direction).sum(), leaves)])
    for value, truth in zip(*found, strict=True):
        torch.testing.assert_close(value, truth, rtol=1e-11, atol=1e-11)


def test_second_derivatives() -> None:
    weights, biases = networks(1)
    x = torch.randn(6, 5, dtype=torch.float64, requires_grad=True)
    owners = torch.tensor([1, 0, 1, 6, 2, 1])
    first = weights[0].requires_grad_()
    assert torch.autograd.gradgradcheck(lambda x, w: grouped_mlp([x], owners, [w, *weights[1:]], biases), (x, first))


def test_nan_stays_in_its_row() -> None:
    weights, biases = networks()
    x, owners = torch.randn(40, 5, dtype=torch.float64), torch.arange(40) % 3
    plain = grouped_mlp([x], owners, weights, biases)
    x[7] = torch.nan
    spoilt = grouped_mlp([x], owners, weights, biases)
    assert bool(spoilt[7].isnan().all())
    others = torch.arange(40) != 7
    torch.testing.assert_close(spoilt[others], plain[others])


@pytest.mark.parametrize("kind", OWNERS)
def test_chunks_have_a_place_for_each_row(kind: str) -> None:
    owners = OWNERS[kind]
    places, chunk_networks, size = chunks_of(owners, NETWORKS)
    assert len(places.unique()) == len(owners)
    assert torch.equal(chunk_networks[places // size], owners)
    assert MIN_CHUNK <= size <= MAX_CHUNK
    assert size & (size - 1) == 0
    busy = len(owners.unique())
    assert len(chunk_networks) <= 2 * busy
    assert len(chunk_networks) * size <= max(3 * len(owners), MIN_CHUNK * 2 * busy)
    assert set(chunk_networks.tolist()) == set(owners.tolist())


def test_what_does_not_fit_is_refused() -> None:
    weights, biases = networks()
    x, owners = torch.randn(4, 5, dtype=torch.float64), torch.tensor([0, 1, 2, 3])
    with pytest.raises(ValueError, match="do not fit inputs of 6 features"):
        grouped_mlp([x, x[:, :1]], owners, weights, biases)
    with pytest.raises(ValueError, match="networks for 3 rows"):
        grouped_mlp([x], owners[:3], weights, biases)
    with pytest.raises(ValueError, match="do not fit"):
        grouped_mlp([x], owners, weights, [bias[:5] for bias in biases])
    with pytest.raises(IndexError, match="networks: index 7 is out of range; there are 7"):
        grouped_mlp([x], owners + 4, weights, biases)
