"""Many small networks at once: each row equals its own network's output, in value and gradient."""

from collections.abc import Callable, Sequence
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from nerfloom.kernels.adam.adam import sparse_adam_reference
from nerfloom.kernels.adam.row_gradient import RowGradient, table_rows
from nerfloom.kernels.math import MAX_LOG_DENSITY
from nerfloom.kernels.networks.grouped import (
    MAX_CHUNK,
    MIN_CHUNK,
    chunks_of,
    grouped_density_mlp,
    grouped_density_mlp_reference,
    grouped_mlp,
    grouped_mlp_reference,
    groups_of,
    layers_of,
    parameter_count,
)
from nerfloom.kernels.networks.mlp import Activation, mlp_reference
from tests.kernels.compiled import needs_kernels, relative_error

NETWORKS, WIDTHS = 7, (5, 6, 4, 3)
FIELD = (63, 32, 32, 33), (59, 32, 3)
"""Widths of KiloNeRF's two networks."""
SHAPES = (WIDTHS, *FIELD, (5, 1), (9, 17, 33, 48, 2), (7, 16, 16, 16, 16, 16, 16, 16, 5))


def networks(widths: Sequence[int] = WIDTHS, seed: int = 0) -> tuple[list[Tensor], list[Tensor]]:
    """Weights and biases of NETWORKS random networks, in float64."""
    torch.manual_seed(seed)
    sizes = list(pairwise(widths))
    weights = [
        torch.randn(NETWORKS, after, before, dtype=torch.float64) * (2 / before) ** 0.5 for before, after in sizes
    ]
    return weights, [torch.randn(NETWORKS, after, dtype=torch.float64) for after in widths[1:]]


def as_table(weights: list[Tensor], biases: list[Tensor]) -> Tensor:
    return torch.cat([part.flatten(1) for layer in zip(weights, biases, strict=True) for part in layer], dim=1)


def one_by_one(
    inputs: Sequence[Tensor], owners: Tensor, table: Tensor, widths: Sequence[int], activation: Activation = "none"
) -> Tensor:
    """A loop over the networks, and in it over nothing."""
    x = torch.cat(list(inputs), dim=-1)
    out = x.new_zeros(len(x), widths[-1])
    for network in range(NETWORKS):
        rows, own, biases, first = (owners == network).nonzero()[:, 0], [], [], 0
        for before, after in pairwise(widths):
            own.append(table[network, first : first + before * after].view(after, before))
            biases.append(table[network, first + before * after : first + (before + 1) * after])
            first += (before + 1) * after
        out = out.index_copy(0, rows, mlp_reference([x[rows]], own, activation, biases))
    return out


def value_and_gradients(
    run: Callable[..., Tensor], inputs: list[Tensor], table: Tensor, direction: Tensor, kind: torch.dtype
) -> list[Tensor]:
    """Results of `run` for inputs and table, and the gradients of them all along `direction`."""
    leaves = [values.to(kind, copy=True).requires_grad_() for values in (*inputs, table)]
    out = run(leaves[:-1], leaves[-1])
    return [out.detach(), *torch.autograd.grad((out * direction.to(kind)).sum(), leaves)]


OWNERS = {
    "mixed": torch.tensor([3, 0, 3, 6, 0, 3, 5, 3, 3, 1, 6, 0, 3]),  # networks 2 and 4 have no row
    "one network": torch.full((40,), 4),
    "one row": torch.tensor([6]),
    "none": torch.zeros(0, dtype=torch.int64),
    "uneven": torch.cat([torch.full((900,), 2), torch.arange(7), torch.full((30,), 5)]),
}
BLOCKS = {
    **{kind: OWNERS[kind] for kind in ("mixed", "one network", "one row", "none")},
    "blocks": torch.cat([torch.full((70,), 2), torch.arange(7), torch.full((33,), 5)]),
}
PIECES = torch.cat([torch.full((2100,), 1), torch.full((1023,), 3), torch.full((1025,), 4), torch.arange(7)]).roll(500)
"""Rows of networks with gradients summed in three pieces, in one, and in two."""


@pytest.mark.parametrize("activation", ["none", "relu", "sigmoid"])
@pytest.mark.parametrize("kind", OWNERS)
def test_each_row_is_that_of_its_network(kind: str, activation: Activation) -> None:
    """In PyTorch, in float64."""
    owners, table = OWNERS[kind], as_table(*networks())
    inputs = [torch.randn(len(owners), width, dtype=torch.float64) for width in (2, 3)]
    direction = torch.randn(len(owners), WIDTHS[-1], dtype=torch.float64)
    found = [
        value_and_gradients(
            lambda x, t, form=form: form(x, owners, t, WIDTHS, activation), inputs, table, direction, torch.float64
        )
        for form in (grouped_mlp, one_by_one)
    ]
    for value, truth in zip(*found, strict=True):
        torch.testing.assert_close(value, truth, rtol=1e-11, atol=1e-11)


def assert_as_in_float64(owners: Tensor, widths: tuple[int, ...], activation: Activation) -> None:
    """Compare with float64 for an input of two parts; a third of the rows has no gradient."""
    table = as_table(*networks(widths))
    inputs = [torch.randn(len(owners), width, dtype=torch.float64) for width in (2, widths[0] - 2)]
    direction = torch.randn(len(owners), widths[-1], dtype=torch.float64)
    direction[1::3] = 0
    single, exact = (
        value_and_gradients(
            lambda x, t, form=form: form(x, owners, t, widths, activation), inputs, table, direction, dtype
        )
        for form, dtype in ((grouped_mlp, torch.float32), (one_by_one, torch.float64))
    )
    for value, truth in zip(single, exact, strict=True):
        assert value.shape == truth.shape
        error = relative_error(value, truth)
        print(f"relative error {error:.1g}")
        assert error < 5e-5
    without_rows = sorted(set(range(NETWORKS)) - set(owners.tolist()))
    assert not bool(single[-1][without_rows].any())


@needs_kernels
@pytest.mark.parametrize("kind", BLOCKS)
@pytest.mark.parametrize("widths", SHAPES, ids=str)
def test_compiled_against_float64(widths: tuple[int, ...], kind: str) -> None:
    assert_as_in_float64(BLOCKS[kind], widths, "sigmoid")


@needs_kernels
@pytest.mark.parametrize("activation", ["none", "relu"])
def test_networks_of_many_rows_against_float64(activation: Activation) -> None:
    assert_as_in_float64(PIECES, WIDTHS, activation)


@pytest.mark.parametrize("asked", ["density", "features", "both"])
@pytest.mark.parametrize("kind", OWNERS)
def test_density_and_features_against_float64(kind: str, asked: str) -> None:
    """Log-densities go beyond 15, where they are clipped. The first feature is the network, without a gradient."""
    owners, table = OWNERS[kind], as_table(*networks())
    table[:, -15:-11] *= 8  # the last layer's weights of the first output
    x = torch.randn(len(owners), 5, dtype=torch.float64)
    of_density, of_features = torch.randn(len(owners)).double() * 1e-3, torch.randn(len(owners), 3).double()
    of_density[1::3] = of_features[1::3] = 0
    found = []
    for form, dtype in ((grouped_density_mlp, torch.float32), (grouped_density_mlp_reference, torch.float64)):
        leaves = [values.to(dtype, copy=True).requires_grad_() for values in (x, table)]
        density, features = form(leaves[:1], owners, leaves[1], WIDTHS)
        terms = {
            "density": (density * of_density.to(dtype)).sum(),
            "features": (features * of_features.to(dtype)).sum(),
        }
        loss = terms["density"] + terms["features"] if asked == "both" else terms[asked]
        found.append([density.detach().log(), features.detach(), *torch.autograd.grad(loss, leaves)])
    for value, truth in zip(*found, strict=True):
        assert value.shape == truth.shape
        assert relative_error(value, truth) < 1e-4
    alone = one_by_one([x], owners, table, WIDTHS)
    torch.testing.assert_close(found[1][0], alone[:, 0].clamp(max=MAX_LOG_DENSITY), rtol=1e-9, atol=1e-9)
    for _, features, *_ in found:
        assert features[:, 0].tolist() == owners.tolist()


def test_layers_are_views_of_the_table() -> None:
    weights, biases = networks()
    found = layers_of(as_table(weights, biases), WIDTHS)
    assert parameter_count(WIDTHS) == 5 * 6 + 6 + 6 * 4 + 4 + 4 * 3 + 3
    for values, truth in zip((*found[0], *found[1]), (*weights, *biases), strict=True):
        assert torch.equal(values, truth)


@needs_kernels
def test_columns_of_a_larger_tensor_are_an_input() -> None:
    """The features of one network, without the first, are the next one's input without a copy."""
    owners, table, wide = OWNERS["mixed"], as_table(*networks()).float(), torch.randn(13, 9, requires_grad=True)
    parts, copied = [wide[:, 1:4], wide[:, 7:]], [wide[:, 1:4].contiguous(), wide[:, 7:].contiguous()]
    found = []
    for inputs in (parts, copied):
        out = grouped_mlp(inputs, owners, table, WIDTHS)
        found.append([out.detach(), *torch.autograd.grad(out.square().sum(), wide)])
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


@needs_kernels
@pytest.mark.parametrize("kind", OWNERS)
def test_rows_are_sorted_by_network(kind: str) -> None:
    owners = OWNERS[kind]
    order, used, starts = groups_of(owners, NETWORKS)
    assert torch.equal(order, owners.argsort(stable=True))
    assert used.tolist() == owners.unique().tolist()
    assert starts.diff().tolist() == [int((owners == network).sum()) for network in used.tolist()]
    assert int(starts[0]) == 0


@needs_kernels
@pytest.mark.parametrize("widths", [WIDTHS, FIELD[0]], ids=str)
def test_threads_agree_bit_for_bit(widths: tuple[int, ...]) -> None:
    """Some networks have a few rows, and one has rows that are summed in several pieces."""
    owners = torch.cat([PIECES, torch.randint(NETWORKS, (700,))])
    table, x = as_table(*networks(widths)).float(), torch.randn(len(owners), widths[0])
    direction, before, found = torch.randn(len(owners), widths[-1]), torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3, 2):
            torch.set_num_threads(threads)
            found.append(
                value_and_gradients(
                    lambda x, t: grouped_mlp(x, owners, t, widths), [x], table, direction, torch.float32
                )
            )
    finally:
        torch.set_num_threads(before)
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_second_derivatives() -> None:
    widths, owners, rows = (3, 4, 2), torch.tensor([1, 0, 1, 6, 1]), torch.tensor([0, 1, 6])
    table = as_table(*networks(widths, seed=1))
    x = torch.randn(5, 3, dtype=torch.float64, requires_grad=True)

    def of_used(x: Tensor, used: Tensor) -> Tensor:
        return grouped_mlp([x], owners, table.index_copy(0, rows, used), widths)

    assert torch.autograd.gradgradcheck(of_used, (x, table[rows].requires_grad_()))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nan_stays_in_its_row(dtype: torch.dtype) -> None:
    table = as_table(*networks()).to(dtype)
    x, owners = torch.randn(40, 5, dtype=dtype), torch.arange(40) % 3
    plain = grouped_mlp([x], owners, table, WIDTHS)
    x[7] = torch.nan
    spoilt = grouped_mlp([x], owners, table, WIDTHS)
    assert bool(spoilt[7].isnan().all())
    others = torch.arange(40) != 7
    torch.testing.assert_close(spoilt[others], plain[others])
    density, features = grouped_density_mlp([x], owners, table, WIDTHS)
    assert density.isnan().nonzero().tolist() == [[7]]
    assert bool(features[7, 1:].isnan().all())


@needs_kernels
def test_a_gradient_that_is_nan_spoils_its_own_network() -> None:
    table, x = as_table(*networks()).float().requires_grad_(), torch.randn(40, 5)
    weight = torch.ones(40)
    weight[7] = torch.nan
    (grouped_mlp([x], torch.arange(40) % 3, table, WIDTHS).sum(-1) * weight).sum().backward()
    assert table.grad is not None
    assert table.grad.isnan().any(-1).nonzero()[:, 0].tolist() == [7 % 3]


@needs_kernels
@pytest.mark.parametrize("asked", ["table", "inputs"])
def test_the_gradient_of_the_table_waits_where_it_is_asked_for(asked: str) -> None:
    owners, values = OWNERS["mixed"], as_table(*networks()).float()
    x, deferred = torch.randn(13, 5, requires_grad=True), RowGradient()
    table, dense = values.clone().requires_grad_(), values.clone().requires_grad_()
    loss = grouped_mlp([x], owners, table, WIDTHS, deferred=deferred).square().sum()
    (true_x, true_table) = torch.autograd.grad(grouped_mlp([x], owners, dense, WIDTHS).square().sum(), (x, dense))
    if asked == "inputs":
        assert torch.equal(torch.autograd.grad(loss, x)[0], true_x)
        assert not deferred.pending
        return
    loss.backward()
    assert table.grad is None
    ((rows, grad),) = deferred.parts
    assert rows.tolist() == owners.unique().tolist()
    assert torch.equal(grad, true_table[rows.long()])
    assert torch.equal(deferred.summed(table.detach()), true_table)
    assert not deferred.pending


@needs_kernels
@pytest.mark.parametrize("same", [True, False])
def test_adam_of_networks_is_sparse_adam(same: bool) -> None:
    """The loss is a sum of outputs of some networks; Adam takes the rows of these or of others."""
    owners, table = OWNERS["mixed"], as_table(*networks()).float().requires_grad_()
    state, count = [torch.rand(table.shape), torch.rand(table.shape), torch.full((NETWORKS,), 3.0)], len(owners)
    x, deferred, rows = torch.randn(count, 5), RowGradient(), owners.unique() if same else torch.tensor([0, 2])
    truth = [values.double().clone() for values in (table.detach(), *state)]
    exact = table.detach().double().requires_grad_()
    for values, kept in ((table, deferred), (exact, None)):
        out = grouped_mlp([x.to(values)], owners, values, WIDTHS, deferred=kept)
        (out.square().sum() + table_rows(values, rows, kept).sin().sum()).backward()
    assert table.grad is None
    assert len(deferred.parts) == 2
    deferred.adam(table.data, *state, 0.1, (0.9, 0.99), 1e-8)
    assert exact.grad is not None
    sparse_adam_reference(truth[0], exact.grad, *truth[1:], 0.1, (0.9, 0.99), 1e-8)
    for value, true in zip((table.detach(), *state), truth, strict=True):
        assert relative_error(value, true) < 1e-4
    assert not deferred.pending


@pytest.mark.parametrize("deferred", [None, RowGradient()])
def test_rows_of_a_table(deferred: RowGradient | None) -> None:
    table, rows = torch.randn(5, 4, requires_grad=True), torch.tensor([1, 4])
    found = table_rows(table, rows, deferred)
    assert torch.equal(found, table[rows])
    found.square().sum().backward()
    grad = deferred.summed(table.detach()) if deferred is not None and deferred.pending else table.grad
    assert grad is not None
    expected = torch.zeros(5, 4)
    expected[rows] = 2 * table.detach()[rows]
    torch.testing.assert_close(grad, expected)


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
    for kind in (torch.float32, torch.float64):
        table = as_table(*networks()).to(kind)
        x, owners = torch.randn(4, 5, dtype=kind), torch.tensor([0, 1, 2, 3])
        with pytest.raises(ValueError, match="5 features do not fit inputs of 6 features"):
            grouped_mlp([x, x[:, :1]], owners, table, WIDTHS)
        with pytest.raises(ValueError, match="networks for 3 rows"):
            grouped_mlp([x], owners[:3], table, WIDTHS)
        with pytest.raises(ValueError, match=r"\(7, 78\), not \(C, 79\)"):
            grouped_mlp([x], owners, table[:, 1:], WIDTHS)
        for bad, wrong in ((owners + 4, 7), (owners - 1, -1)):
            with pytest.raises(IndexError, match=f"networks: index {wrong} is out of range; there are 7"):
                grouped_mlp([x], bad, table, WIDTHS)


@needs_kernels
def test_what_is_too_large_for_the_kernel_is_left_to_torch() -> None:
    x, owners = torch.randn(4, 3), torch.tensor([0, 1, 1, 0])
    for widths in ((3, 385, 2), (3, *[4] * 9)):
        table = torch.randn(2, parameter_count(widths)) / 20
        found, truth = (form([x], owners, table, widths) for form in (grouped_mlp, grouped_mlp_reference))
        assert torch.equal(found, truth)
