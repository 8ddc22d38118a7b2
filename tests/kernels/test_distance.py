"""A distance's network and its gradient: compiled against the reference, the reference against differences."""

from itertools import pairwise

import pytest
import torch
from torch import Tensor

from nerfloom.kernels.adam.adam import sparse_adam
from nerfloom.kernels.grids.hash_grid_layout import HashGridLayout
from nerfloom.kernels.grids.hash_grid_lookup import TableGradient
from nerfloom.kernels.grids.hash_grid_tangent import LOOK_UP, hash_grid_tangent, hash_grid_tangent_reference
from nerfloom.kernels.surfaces.distance import distance_network, distance_network_reference, following_positions
from tests.kernels.compiled import needs_kernels, relative_error

LAYOUT = HashGridLayout.build(4, 4, 40, 9)
WIDTHS = 8, 24, 5
Arguments = tuple[Tensor, Tensor, Tensor, Tensor]


def arguments(count: int = 3000, kind: torch.dtype = torch.float64) -> Arguments:
    """Positions, some of them outside the box or at its faces, table and weights."""
    torch.manual_seed(0)
    positions = torch.cat([torch.rand(count, 3) * 1.1 - 0.05, torch.tensor([[0.0, 0, 0], [1, 1, 1], [1, 0, 0.5]])])
    weights = [torch.randn(out, into) / into**0.5 for into, out in pairwise(WIDTHS)]
    return tuple(each.to(kind) for each in (positions, torch.randn(LAYOUT.num_entries, 2), *weights))  # type: ignore[return-value]


def loss_of(found: Tensor) -> Tensor:
    """A loss of outputs and gradient; its gradient by each depends on the other."""
    torch.manual_seed(1)
    outputs, gradient = found[:, :-3], found[:, -3:]
    eikonal = (gradient.norm(dim=-1) - 1).square().mean()
    loss = (outputs * torch.randn_like(outputs.double()).to(outputs)).mean() + eikonal
    return loss + (outputs[:, 1:4] * gradient).sum(-1).sin().mean()


def gradients(network: object, given: Arguments, **others: object) -> tuple[Tensor, ...]:
    leaves = [each.clone().requires_grad_() for each in given[1:]]
    found = network(given[0], *leaves, LAYOUT, **others)  # type: ignore[operator]
    return found.detach(), *torch.autograd.grad(loss_of(found), leaves)


@needs_kernels
def test_the_derivative_along_a_direction_equals_the_reference() -> None:
    positions, table, *_ = arguments()
    points = torch.cat([positions, torch.randn_like(positions)], dim=-1)
    truth = hash_grid_tangent_reference(points, table, LAYOUT)
    assert relative_error(hash_grid_tangent(points.float(), table.float(), LAYOUT), truth) < 2e-5


@needs_kernels
def test_values_and_second_derivatives_equal_the_reference() -> None:
    given = arguments()
    truths = gradients(distance_network_reference, given)
    values = gradients(distance_network, tuple(each.float() for each in given))  # type: ignore[arg-type]
    for name, value, truth in zip(("value", "table", "first", "second"), values, truths, strict=True):
        error = relative_error(value, truth)
        print(f"{name}: off by {error:.1e} of the largest")
        assert error < 2e-5


@needs_kernels
def test_rows_without_a_gradient_change_nothing() -> None:
    given = tuple(each.float() for each in arguments())
    leaves = [each.clone().requires_grad_() for each in given[1:]]
    found = distance_network(given[0], *leaves, LAYOUT)  # type: ignore[arg-type]
    some = torch.autograd.grad(loss_of(found[:500]), leaves)
    alone = torch.autograd.grad(loss_of(distance_network(given[0][:500], *leaves, LAYOUT)), leaves)  # type: ignore[arg-type]
    for value, truth in zip(some, alone, strict=True):
        assert relative_error(value, truth) < 1e-5
    nothing = torch.autograd.grad((0 * distance_network(given[0], *leaves, LAYOUT)).sum(), leaves)  # type: ignore[arg-type]
    assert all(not each.any() for each in nothing)
    none = torch.autograd.grad(distance_network(given[0][:0], *leaves, LAYOUT).sum(), leaves)  # type: ignore[arg-type]
    assert all(not each.any() for each in none)


@needs_kernels
def test_a_deferred_gradient_is_that_of_the_table() -> None:
    """Two look-ups, and Adam on their sum."""
    positions, table, first, second = (each.float() for each in arguments())
    deferred, there = TableGradient(LOOK_UP, LAYOUT), table.clone().requires_grad_()
    halves = positions[:1200], positions[1200:]
    sum(loss_of(distance_network(half, there, first, second, LAYOUT, deferred)) for half in halves).backward()  # type: ignore[union-attr]
    assert there.grad is None
    whole = table.clone().requires_grad_()
    sum(loss_of(distance_network(half, whole, first, second, LAYOUT)) for half in halves).backward()  # type: ignore[union-attr]
    assert whole.grad is not None
    state, other = ([torch.zeros_like(table), torch.zeros_like(table), torch.zeros(len(table))] for _ in range(2))
    settings = 0.01, (0.9, 0.99), 1e-15
    with torch.no_grad():
        deferred.adam(there.data, *state, *settings)
        sparse_adam(whole.data, whole.grad, *other, *settings)
    assert not deferred.pending
    moments = relative_error(state[0], other[0]), relative_error(state[1], other[1])
    assert max(moments) < 1e-5
    assert bool((state[2] == other[2]).all())


def test_the_reference_has_the_gradient_of_its_output() -> None:
    """Central differences inside cells agree, also for the loss, by table, weights and positions."""
    positions, table, first, second = arguments(200)
    inside = positions[(positions > 0.01).all(-1) & (positions < 0.99).all(-1)][:50]
    found = distance_network_reference(inside, table, first, second, LAYOUT)
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[axis] = 1e-7
        ends = [
            distance_network_reference(inside + side * step, table, first, second, LAYOUT)[:, 0] for side in (1, -1)
        ]
        error = ((ends[0] - ends[1]) / 2e-7 - found[:, -3 + axis]).abs()
        assert error.median() < 1e-6  # a few steps cross a cell's face or switch a unit
    few = inside[:3].clone().requires_grad_()
    leaves = [each.clone().requires_grad_() for each in (table, first, second)]
    assert torch.autograd.gradcheck(
        lambda *given: loss_of(distance_network_reference(*given, LAYOUT)), (few, *leaves), fast_mode=True
    )


def test_autocast_leaves_distances_their_digits() -> None:
    """Values and gradients of the form in PyTorch, and the gradient by positions; bfloat16 has three digits."""
    positions, *network = arguments(300)
    inside = positions[(positions > 0.01).all(-1) & (positions < 0.99).all(-1)]

    def found(kind: torch.dtype) -> tuple[Tensor, ...]:
        where = inside.to(kind, copy=True).requires_grad_()
        table, first, second = (each.to(kind, copy=True).requires_grad_() for each in network)
        with torch.autocast("cpu", torch.bfloat16, enabled=kind == torch.float32):
            values = distance_network_reference(where.detach(), table, first, second, LAYOUT)
            followed = values.detach() + following_positions(where, table, first, second, LAYOUT)
        slopes = torch.autograd.grad(loss_of(values), (table, first, second))
        return values.detach(), *slopes, *torch.autograd.grad(loss_of(followed), where)

    for value, truth in zip(found(torch.float32), found(torch.float64), strict=True):
        assert value.dtype == torch.float32
        assert relative_error(value, truth) < 1e-4


@pytest.mark.parametrize("wrong", [(2, (24, 7)), (3, (5, 23))])
def test_weights_that_do_not_fit_are_refused(wrong: tuple[int, tuple[int, int]]) -> None:
    given = list(arguments(10))
    given[wrong[0]] = torch.zeros(wrong[1], dtype=torch.float64)
    with pytest.raises(ValueError, match="do not fit 4 levels"):
        distance_network(*given, LAYOUT)  # type: ignore[arg-type]
