"""Sparse Adam: each entry sees torch's own Adam on the sequence of its gradients that are not zero."""

import functools

import pytest
import torch

from nerfloom.kernels import native
from nerfloom.kernels.adam.adam import (
    ALL_FINITE,
    DENSE_ADAM,
    SPARSE_ADAM,
    all_finite,
    all_finite_reference,
    dense_adam,
    dense_adam_reference,
    sparse_adam,
    sparse_adam_reference,
)
from nerfloom.kernels.dispatch import FEW_OPERATIONS
from tests.kernels.compiled import needs_kernels, relative_error

BETAS, EPS = (0.9, 0.99), 1e-15
MASKED = next(each.run for each in SPARSE_ADAM.implementations if each.backend is FEW_OPERATIONS)
"""The form that does not ask which entries have a gradient."""


def tables(entries: int, features: int, dtype: torch.dtype = torch.float32) -> list[torch.Tensor]:
    """values, mean, square and seen."""
    torch.manual_seed(0)
    values = torch.randn(entries, features, dtype=dtype)
    return [values, torch.zeros_like(values), torch.zeros_like(values), torch.zeros(entries, dtype=dtype)]


def gradients(entries: int, features: int, step: int) -> torch.Tensor:
    """A gradient on about a fifth of the entries; the last entry is met at step 40 for the first time."""
    generator = torch.Generator().manual_seed(step)
    grad = torch.randn(entries, features, generator=generator) * 10.0 ** float(-step % 7)
    grad[torch.rand(entries, generator=generator) > 0.2] = 0
    grad[-1] = 0.5 if step == 40 else 0
    return grad


@functools.cache
def truth(entries: int, features: int, steps: int) -> torch.Tensor:
    """Where each entry moves to: torch's Adam, which knows it as a parameter without a gradient while it has none."""
    singles = [torch.nn.Parameter(row.clone()) for row in tables(entries, features)[0].double()]
    optimizer = torch.optim.Adam(singles, lr=1e-2, betas=BETAS, eps=EPS)
    for step in range(steps):
        grad = gradients(entries, features, step)
        optimizer.zero_grad(set_to_none=True)
        for entry in grad.any(-1).nonzero().squeeze(-1).tolist():
            singles[entry].grad = grad[entry].double()
        optimizer.step()
    return torch.stack([p.detach() for p in singles])


@pytest.mark.parametrize("features", [1, 2, 3, 4, 5, 8, 16, 32, 45, 48])
@pytest.mark.parametrize("update", [sparse_adam, sparse_adam_reference, MASKED])
def test_each_entry_sees_adam_on_its_own_gradients(update, features: int) -> None:
    entries, steps = 301, 60
    values, mean, square, seen = tables(entries, features)
    before = values.double().clone()
    for step in range(steps):
        grad = gradients(entries, features, step)
        touched = grad.any(-1)
        assert update(values, grad, mean, square, seen, 1e-2, BETAS, EPS) == int(touched.sum())
        assert not grad.any()
    assert relative_error(values.double() - before, truth(entries, features, steps) - before) < 1e-4
    late = (values[-1].double() - before[-1]).abs()
    torch.testing.assert_close(late, torch.full_like(late, 1e-2), rtol=1e-4, atol=0)  # its first step is a full one
    assert seen[-1] == 1


@needs_kernels
@pytest.mark.parametrize("features", [1, 2, 3, 4, 16, 45, 48])
def test_compiled_equals_reference_far_into_a_run(features: int) -> None:
    """Counts beyond the table of corrections, a size that is not a multiple of a vector, tiny gradients, signed
    zeros."""
    mine, theirs = tables(1003, features), tables(1003, features)
    for state in (mine, theirs):
        state[3][:500] = 5000
        state[2][:] = 1e-20
    for step in range(5):
        grad = gradients(1003, features, step) * 1e-12
        grad[::3, 0] = 0
        grad[::5] *= -1
        updated = sparse_adam(mine[0], grad.clone(), *mine[1:], 1e-2, BETAS, EPS)
        assert updated == sparse_adam_reference(theirs[0], grad.clone(), *theirs[1:], 1e-2, BETAS, EPS)
    for a, b in zip(mine[:3], theirs[:3], strict=True):
        assert relative_error(a, b) < 1e-5
    assert torch.equal(mine[3].clamp(max=5000), theirs[3].clamp(max=5000))  # settled counts need not grow


@needs_kernels
@pytest.mark.parametrize("features", [1, 2, 3, 4, 8, 45])
def test_an_entry_moves_alike_whatever_its_neighbours(features: int) -> None:
    """Entries in another order get the same bits: settled ones beside fresh ones, used ones beside unused ones."""
    entries = 512  # whole vectors
    order = torch.randperm(entries, generator=torch.Generator().manual_seed(5))
    values, mean, square, seen = tables(entries, features)
    seen[:] = torch.tensor([0.0, 1.0, 900.0, 5000.0]).repeat_interleave(entries // 4)  # whole vectors of each kind
    shuffled = [tensor[order] for tensor in (values, mean, square, seen)]
    for step in range(3):
        grad = gradients(entries, features, step)
        grad[::7, 0] = -0.0
        count = sparse_adam(values, grad.clone(), mean, square, seen, 1e-2, BETAS, EPS)
        assert count == sparse_adam(shuffled[0], grad[order], *shuffled[1:], 1e-2, BETAS, EPS) > 0
    for tensor, other in zip((values, mean, square, seen.clamp(max=5000)), shuffled, strict=True):
        assert torch.equal(tensor[order], other.clamp(max=5000) if other.ndim == 1 else other)


@needs_kernels
@pytest.mark.parametrize("features", [2, 3, 45])
def test_threads_give_the_same_bits(features: int) -> None:
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            state = tables(20_000, features)
            for step in range(3):
                sparse_adam(state[0], gradients(20_000, features, step), *state[1:], 1e-2, BETAS, EPS)
            found.append(state)
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for other in found[1:] for a, b in zip(found[0], other, strict=True))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("place", [0, 4999, 10_002])
def test_all_finite_sees_a_single_bad_value(bad: float, place: int) -> None:
    values = torch.randn(10_003)
    others = [torch.full((100,), 3e38), torch.zeros(0)]  # with infinite squares, and empty
    for judged in (all_finite, all_finite_reference, *(each.run for each in ALL_FINITE.implementations)):
        if judged is ALL_FINITE.implementations[0].run and not native.available():
            continue
        assert judged([values, *others])
        assert judged(others[1:])
        assert judged([])
        broken = values.clone()
        broken[place] = bad
        assert not judged([*others, broken])


def moved(update, *verdict: object, features: int = 2, rate: object = 1e-2) -> list[torch.Tensor]:
    """Tables and a gradient after an update."""
    state, grad = tables(300, features), gradients(300, features, 3)
    update(state[0], grad, *state[1:], rate, BETAS, EPS, *verdict)
    return [*state, grad]


@pytest.mark.parametrize("update", [sparse_adam, sparse_adam_reference, MASKED])
def test_rate_and_verdict_on_the_device_are_those_of_python(update) -> None:
    usual, start = moved(update), [*tables(300, 2), torch.zeros(300, 2)]
    for found in (moved(update, torch.zeros(())), moved(update, rate=torch.tensor(1e-2))):
        for one, other in zip(found, usual, strict=True):
            torch.testing.assert_close(one, other)
    dropped = moved(update, torch.ones(()), rate=torch.tensor(1e-2))
    assert all(torch.equal(one, other) for one, other in zip(dropped, start, strict=True))
    assert not torch.equal(usual[0], start[0])
    spoilt, grad = tables(300, 2), torch.full((300, 2), torch.nan)
    update(spoilt[0], grad, *spoilt[1:], 1e-2, BETAS, EPS, torch.ones(()))
    assert torch.equal(spoilt[0], start[0])
    assert not grad.any()


DENSE = [dense_adam, dense_adam_reference, *(each.run for each in DENSE_ADAM.implementations)]


@pytest.mark.parametrize("update", DENSE)
def test_verdict_and_rate_of_dense_adam(update) -> None:
    def after(rate: object, *verdict: object) -> list[torch.Tensor]:
        torch.manual_seed(0)
        values, grads, means, squares = ([torch.rand(3, 4), torch.rand(5)] for _ in range(4))
        steps = [torch.tensor(3.0), torch.tensor(8.0)]
        update(values, grads, means, squares, steps, rate, BETAS, 1e-8, *verdict)
        return [*values, *means, *squares, *steps]

    if update is DENSE_ADAM.implementations[0].run:  # C++; Python decides
        if native.available():
            torch.testing.assert_close(after(0.01)[0], dense_once(0.01))
        return
    torch.testing.assert_close(after(0.01)[0], dense_once(0.01))
    for found in (after(torch.tensor(0.01)), after(torch.tensor(0.01), torch.zeros(()))):
        for one, other in zip(found, after(0.01), strict=True):
            torch.testing.assert_close(one, other)
    dropped = after(torch.tensor(0.01), torch.ones(()))
    torch.manual_seed(0)
    assert torch.equal(dropped[0], torch.rand(3, 4))
    assert [float(step) for step in dropped[-2:]] == [3, 8]


def dense_once(rate: float) -> torch.Tensor:
    """The first parameter of the test above after its fourth update, by the paper's formulas."""
    torch.manual_seed(0)
    (value, _), (grad, _), (mean, _), (square, _) = ([torch.rand(3, 4), torch.rand(5)] for _ in range(4))
    mean, square = 0.9 * mean + 0.1 * grad, 0.99 * square + 0.01 * grad * grad
    return value - rate * (mean / (1 - 0.9**4)) / ((square / (1 - 0.99**4)).sqrt() + 1e-8)
