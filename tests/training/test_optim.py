"""Learning-rate schedules: values by hand."""

import math

import pytest

from framework.base.config import TrainConfig
from framework.training.optim import learning_rate_factor


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


def test_warm_up_is_linear() -> None:
    config = TrainConfig(lr_schedule="constant", lr_warmup_steps=4)
    assert [learning_rate_factor(config, step, 0.0) for step in (0, 1, 3, 9)] == [0.25, 0.5, 1.0, 1.0]
