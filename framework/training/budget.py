"""The spent fraction of a run's budget, and the reason why training ends."""

from __future__ import annotations

import signal
from collections.abc import Sequence

from nerfloom.base.config import TrainConfig
from nerfloom.base.counts import counted
from nerfloom.training.state import State

EVALUATION_SHARE, EVALUATION_SECONDS = 0.5, 10.0
"""Maximum time of an automatic evaluation: this fraction of the training time, or this many seconds if that is more."""


def spent(config: TrainConfig, state: State) -> float:
    """Return the spent fraction of the budget, 0 to 1: of steps or seconds, whichever is larger.

    Without a limit it is 0.

    Args:
        config: settings, with the budget.
        state: state of the run.
    """
    done = 0.0 if config.max_num_iterations is None else state.step / config.max_num_iterations
    if config.max_seconds is not None:
        done = max(done, state.seconds / config.max_seconds)
    return min(done, 1.0)


def reason_to_stop(config: TrainConfig, state: State, stopped: Sequence[int]) -> str | None:
    """Return why training ends before the next step, as text; None if it continues.

    `config` has the budget and the target. `stopped` has the numbers of received signals; the first one takes
    precedence over all other reasons.
    """
    if stopped:
        return "stopped by " + signal.Signals(stopped[0]).name
    if config.max_num_iterations is not None and state.step >= config.max_num_iterations:
        return f"{counted(config.max_num_iterations, 'steps')} done"
    if config.max_seconds is not None and state.seconds >= config.max_seconds:
        return f"{config.max_seconds:g} s of training spent"
    target, curve = config.target_psnr, state.curve
    if target is not None and curve and curve[-1][2] >= target:
        return f"{target:g} dB reached"
    return None


def evaluation_seconds(config: TrainConfig, state: State) -> float | None:
    """Return the maximum seconds of an evaluation by the run's `config` and `state`; None with `--eval all`."""
    return None if config.eval == "all" else max(EVALUATION_SHARE * state.seconds, EVALUATION_SECONDS)
