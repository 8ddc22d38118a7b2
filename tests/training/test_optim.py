"""Learning-rate schedules: values by hand. The optimiser's state: beside PyTorch's Adam."""

import copy
import math
from typing import Any

import pytest
import torch

from nerfloom.base.config import TrainConfig
from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.training.optim import Adam, learning_rate_factor


@pytest.mark.parametrize(
    ("schedule", "at_half"),
    [("constant", 1.0), ("exponential", math.sqrt(0.1)), ("cosine", 0.55), ("hold-exponential", 1.0)],
)
def test_ends_and_middle(schedule: str, at_half: float) -> None:
    config = TrainConfig(lr_schedule=schedule, lr_final=0.1)  # type: ignore[arg-type]
    assert learning_rate_factor(config, 0, 0.0) == pytest.approx(1.0)
    assert learning_rate_factor(config, 0, 0.5) == pytest.approx(at_half)
    expected = 1.0 if schedule == "constant" else 0.1
    assert learning_rate_factor(config, 0, 1.0) == pytest.approx(expected)
    assert learning_rate_factor(config, 0, 1.7) == pytest.approx(expected)


def test_holding_schedule_falls_in_the_second_half() -> None:
    config = TrainConfig(lr_schedule="hold-exponential", lr_final=0.01)
    assert learning_rate_factor(config, 0, 0.75) == pytest.approx(0.1)


def test_a_group_may_fall_in_the_last_part_alone() -> None:
    """It has its full rate for 85 % of the budget, and half of the fall in half of the rest."""
    config = TrainConfig(lr_final=0.01)
    found = [learning_rate_factor(config, 0, progress, "fall-late") for progress in (0.0, 0.5, 0.85, 0.925, 1.0)]
    assert found == pytest.approx([1.0, 1.0, 1.0, 0.1, 0.01])


def test_warm_up_is_linear() -> None:
    config = TrainConfig(lr_schedule="constant", lr_warmup_steps=4)
    assert [learning_rate_factor(config, step, 0.0) for step in (0, 1, 3, 9)] == [0.25, 0.5, 1.0, 1.0]


def test_a_groups_own_schedule_and_warm_up_replace_those_of_the_run() -> None:
    config = TrainConfig(lr_schedule="constant", lr_final=0.01, lr_warmup_steps=4)
    assert learning_rate_factor(config, 1, 0.5, "exponential") == pytest.approx(0.5 * 0.1)
    assert learning_rate_factor(config, 1, 0.5, warmup_steps=8) == 0.25
    assert learning_rate_factor(config, 1, 0.5, "exponential", 0) == pytest.approx(0.1)


def two_groups(seed: int) -> tuple[list[torch.nn.Parameter], list[dict[str, Any]]]:
    torch.manual_seed(seed)
    parameters = [torch.nn.Parameter(torch.randn(shape)) for shape in ((5, 3), (4,), (2, 2))]
    groups = [{"params": parameters[:2], "lr": 0.1}, {"params": parameters[2:], "lr": 0.01, "eps": 1e-3}]
    return parameters, groups


def set_gradients(parameters: list[torch.nn.Parameter], step: int) -> None:
    for index, parameter in enumerate(parameters):
        parameter.grad = torch.randn(parameter.shape, generator=torch.Generator().manual_seed(10 * step + index))


@pytest.mark.parametrize("loads", ["theirs", "ours"])
def test_it_goes_on_from_a_state_of_pytorchs_adam_and_from_its_own(loads: str) -> None:
    theirs, groups = two_groups(0)
    peer = torch.optim.Adam(groups, lr=1.0, betas=(0.8, 0.9), eps=1e-8)
    first, ours_groups = two_groups(0)
    ours = Adam(ours_groups, {}, 1.0, (0.8, 0.9), 1e-8)
    for step in range(3):
        set_gradients(theirs, step)
        set_gradients(first, step)
        peer.step()
        ours.step()
    second, other_groups = two_groups(1)
    resumed = Adam(other_groups, {}, 1.0, (0.1, 0.2), 1e-1)
    resumed.load_state_dict(copy.deepcopy((peer if loads == "theirs" else ours).state_dict()))  # which peer changes on
    assert [group["lr"] for group in resumed.param_groups] == [0.1, 0.01]
    assert [group["betas"] for group in resumed.param_groups] == [(0.8, 0.9)] * 2
    with torch.no_grad():
        for mine, other in zip(second, theirs, strict=True):
            mine.copy_(other)
    for step in range(3, 6):
        set_gradients(theirs, step)
        set_gradients(second, step)
        peer.step()
        resumed.step()
    for mine, other in zip(second, theirs, strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-5, atol=1e-7)


def test_a_state_of_other_groups_is_refused_and_changes_nothing() -> None:
    parameters, groups = two_groups(0)
    optimizer = Adam(groups, {}, 1.0, (0.9, 0.99), 1e-8)
    saved = Adam([{"params": parameters}], {}, 0.5, (0.9, 0.99), 1e-8).state_dict()
    before = optimizer.state
    with pytest.raises(ValueError, match="parameter groups differ"):
        optimizer.load_state_dict(saved)
    assert optimizer.state is before
    assert [group["lr"] for group in optimizer.param_groups] == [0.1, 0.01]
    with pytest.raises(KeyError):
        optimizer.load_state_dict({**optimizer.state_dict(), "state": {}})
    assert optimizer.state is before


def test_a_gradient_that_no_step_took_is_gone_at_the_next() -> None:
    """A dropped step's gradient is gone, also where a table's gradient is kept for the optimiser."""
    torch.manual_seed(0)
    encoding = HashGrid(3, 2, 4, 16, 8, True)
    deferred = {} if encoding.deferred is None else {encoding.table: encoding.deferred}
    optimizer = Adam([{"params": [encoding.table], "sparse": True}], deferred, 0.1, (0.9, 0.99), 1e-8)
    encoding(torch.rand(20, 3)).sum().backward()
    assert optimizer.has_gradient(encoding.table)
    before = encoding.table.detach().clone()
    optimizer.zero_grad()
    assert not optimizer.has_gradient(encoding.table)
    optimizer.step()
    assert torch.equal(encoding.table, before)
    encoding(torch.rand(20, 3)).sum().backward()
    optimizer.step()
    assert not torch.equal(encoding.table, before)


def test_a_gradient_that_waits_and_one_of_autograd_are_one_step() -> None:
    """If a table is looked up, and is a term of the loss itself too, Adam takes the sum of both gradients."""
    found = []
    for waits in (True, False):
        torch.manual_seed(0)
        encoding, points = HashGrid(3, 2, 4, 16, 8, True), torch.rand(20, 3)
        if not waits:
            encoding.deferred = None
        deferred = {} if encoding.deferred is None else {encoding.table: encoding.deferred}
        optimizer = Adam([{"params": [encoding.table], "sparse": True}], deferred, 0.1, (0.9, 0.99), 1e-8)
        for _ in range(2):
            optimizer.zero_grad()
            (encoding(points).sum() + encoding.table.square().sum()).backward()
            optimizer.step()
        found.append((encoding.table.detach(), optimizer.entries))
    torch.testing.assert_close(found[0][0], found[1][0])
    assert found[0][1] == found[1][1]
