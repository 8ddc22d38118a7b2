"""How much of a budget is spent, and the reasons for which a run ends."""

import signal

import pytest

from framework.base.config import TrainConfig
from framework.training.budget import reason_to_stop, spent
from framework.training.state import State

CURVE = ((1.0, 10, 31.0), (2.0, 20, 29.5))


@pytest.mark.parametrize(
    ("step", "seconds", "limit", "share"),
    [
        (0, 0.0, None, 0.0),
        (25, 1e6, None, 0.25),
        (25, 30.0, 60.0, 0.5),
        (75, 30.0, 60.0, 0.75),
        (0, 61.0, 60.0, 1.0),
        (101, 0.0, 60.0, 1.0),
    ],
)
def test_the_budget_that_is_spent_further_counts(step: int, seconds: float, limit: float | None, share: float) -> None:
    config = TrainConfig(max_num_iterations=100, max_seconds=limit)
    assert spent(config, State(step=step, seconds=seconds)) == share


@pytest.mark.parametrize(
    ("step", "seconds", "target", "reason"),
    [
        (99, 59.9, None, None),
        (100, 0.0, None, "100 steps done"),
        (0, 60.0, None, "60 s of training spent"),
        (0, 0.0, 30.0, None),  # the last evaluation counts, not the best
        (0, 0.0, 29.5, "29.5 dB reached"),
    ],
)
def test_a_run_ends_at_its_budget_or_target(
    step: int, seconds: float, target: float | None, reason: str | None
) -> None:
    config = TrainConfig(max_num_iterations=100, max_seconds=60.0, target_psnr=target)
    assert reason_to_stop(config, State(step=step, seconds=seconds, curve=CURVE), []) == reason


def test_a_target_waits_for_an_evaluation_and_a_signal_counts_first() -> None:
    config = TrainConfig(max_num_iterations=100, target_psnr=1.0)
    assert reason_to_stop(config, State(), []) is None
    assert reason_to_stop(config, State(step=100), [signal.SIGTERM, signal.SIGINT]) == "stopped by SIGTERM"
