"""Rows of a parameter that are dropped, reordered or added: Adam's state goes with them."""

import pytest
import torch
from torch import Tensor

from nerfloom.base.optimised import RowChange
from nerfloom.training.optim import Adam

RATE, BETAS, EPS = 1e-2, (0.8, 0.95), 1e-12
ROWS, FEATURES = 7, 3
KEPT = torch.tensor([5, 0, 3, 6])
FRESH = torch.tensor([[0.5, -0.5, 2.0], [1.0, 0.0, -3.0]])


def gradients(step: int, rows: int, sparse: bool) -> Tensor:
    """(rows, FEATURES) of many sizes; in a sparse table some rows have none."""
    generator = torch.Generator().manual_seed(step)
    grad = torch.randn(rows, FEATURES, generator=generator) * 10.0 ** float(step % 5)
    if sparse:
        grad[torch.rand(rows, generator=generator) < 0.3] = 0
    return grad


class Truth:
    """Every row with a float64 Adam of torch's own.

    A dense parameter's rows share a count of steps, so that for a fresh one the steps before it had no gradient; a
    sparse table's rows count their own, and are left alone where they have no gradient.
    """

    def __init__(self, values: Tensor, sparse: bool) -> None:
        self.sparse, self.steps = sparse, 0
        self.rows = [self._begun(row) for row in values]

    def _begun(self, row: Tensor) -> tuple[Tensor, torch.optim.Adam]:
        parameter = torch.nn.Parameter(row.double().clone())
        adam = torch.optim.Adam([parameter], lr=RATE, betas=BETAS, eps=EPS)
        for _ in range(0 if self.sparse else self.steps):
            parameter.grad = torch.zeros_like(parameter)
            adam.step()
        return parameter, adam

    def step(self, grad: Tensor) -> None:
        self.steps += 1
        for (parameter, adam), row in zip(self.rows, grad, strict=True):
            if not self.sparse or bool(row.any()):
                parameter.grad = row.double()
                adam.step()

    def change(self, kept: Tensor, fresh: Tensor) -> None:
        self.rows = [self.rows[index] for index in kept.tolist()] + [self._begun(row) for row in fresh]

    @property
    def values(self) -> Tensor:
        return torch.stack([parameter.detach() for parameter, _ in self.rows])


def optimizer_of(parameter: Tensor, sparse: bool) -> Adam:
    return Adam([{"params": [parameter], "sparse": sparse}], {}, RATE, BETAS, EPS)


def stepped(optimizer: Adam, parameter: torch.nn.Parameter, truth: Truth, steps: range) -> None:
    for step in steps:
        grad = gradients(step, len(parameter), truth.sparse)
        truth.step(grad)
        parameter.grad = grad
        optimizer.step()


@pytest.mark.parametrize("sparse", [False, True], ids=["dense", "sparse"])
def test_rows_go_on_as_if_nothing_else_had_been_there(sparse: bool) -> None:
    torch.manual_seed(0)
    parameter = torch.nn.Parameter(torch.randn(ROWS, FEATURES))
    optimizer, truth = optimizer_of(parameter, sparse), Truth(parameter.detach(), sparse)
    stepped(optimizer, parameter, truth, range(9))
    before = {name: value.clone() for name, value in optimizer.state[parameter].items()}
    parameter.grad = torch.ones_like(parameter)
    optimizer.change_rows(RowChange(parameter, KEPT, FRESH))
    truth.change(KEPT, FRESH)
    state = optimizer.state[parameter]
    assert state.keys() == before.keys()
    for name in ("exp_avg", "exp_avg_sq", *(["seen"] if sparse else [])):
        assert torch.equal(state[name][: len(KEPT)], before[name][KEPT])
        assert not bool(state[name][len(KEPT) :].any())
        assert len(state[name]) == len(parameter) == len(KEPT) + len(FRESH)
    assert parameter.grad is None  # of the old rows
    torch.testing.assert_close(parameter.detach().double(), truth.values, rtol=1e-5, atol=1e-6)
    start = truth.values.clone()
    stepped(optimizer, parameter, truth, range(9, 30))
    moved, expected = parameter.detach().double() - start, truth.values - start
    torch.testing.assert_close(moved, expected, rtol=1e-4, atol=1e-5)
    assert bool((expected.abs() > 1e-3).any(-1).all())  # every row, the fresh ones too


@pytest.mark.parametrize("sparse", [False, True], ids=["dense", "sparse"])
def test_rows_are_dropped_without_any_that_are_fresh(sparse: bool) -> None:
    parameter = torch.nn.Parameter(torch.arange(12.0).view(4, 3))
    optimizer, truth = optimizer_of(parameter, sparse), Truth(parameter.detach(), sparse)
    stepped(optimizer, parameter, truth, range(3))
    optimizer.change_rows(RowChange(parameter, torch.tensor([2])))
    truth.change(torch.tensor([2]), torch.zeros(0, 3))
    stepped(optimizer, parameter, truth, range(3, 6))
    assert parameter.shape == (1, 3)
    torch.testing.assert_close(parameter.detach().double(), truth.values, rtol=1e-5, atol=1e-5)


def test_a_changed_parameter_is_the_same_one() -> None:
    """So that the module that holds it, and the optimiser's groups, hold the new rows."""
    module = torch.nn.ParameterDict({"rows": torch.nn.Parameter(torch.zeros(3, 2))})
    optimizer = optimizer_of(module["rows"], sparse=False)
    optimizer.change_rows(RowChange(module["rows"], torch.tensor([0]), torch.ones(4, 2)))
    assert module["rows"].shape == (5, 2)
    assert optimizer.param_groups[0]["params"][0] is module["rows"]
    assert [state["exp_avg"].shape for state in optimizer.state.values()] == [(5, 2)]


def test_rows_of_a_parameter_that_is_not_optimised_are_refused() -> None:
    optimizer = optimizer_of(torch.nn.Parameter(torch.zeros(3, 2)), sparse=False)
    with pytest.raises(ValueError, match="the optimiser does not hold"):
        optimizer.change_rows(RowChange(torch.nn.Parameter(torch.zeros(3, 2)), torch.tensor([0])))
