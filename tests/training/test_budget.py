"""The spent share of a budget, and the reasons why a run ends."""

import signal
from pathlib import Path

import pytest

from nerfloom.base.config import TrainConfig
from nerfloom.base.errors import FlagError
from nerfloom.base.step_limit import limited_as_given
from nerfloom.cli.train import run_of
from nerfloom.training.budget import evaluation_seconds, reason_to_stop, spent
from nerfloom.training.run import Run, create_folder, read_run
from nerfloom.training.state import State

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


def test_seconds_alone_have_no_limit_of_steps_and_schedules_follow_the_seconds() -> None:
    config = limited_as_given(TrainConfig(max_seconds=60.0), {"max_seconds"})
    fast = State(step=10**7, seconds=30.0)
    assert reason_to_stop(config, fast, []) is None
    assert spent(config, fast) == 0.5
    assert reason_to_stop(config, State(step=10**7, seconds=60.0), []) == "60 s of training spent"


@pytest.mark.parametrize("given", [{"max_seconds", "max_num_iterations"}, {"max_num_iterations"}, set()])
def test_of_both_limits_the_one_that_comes_first_counts(given: set[str]) -> None:
    config = limited_as_given(TrainConfig(max_num_iterations=100, max_seconds=60.0), given)
    assert reason_to_stop(config, State(step=100, seconds=1.0), []) == "100 steps done"


def test_no_limit_at_all_is_refused() -> None:
    with pytest.raises(FlagError, match="--max-num-iterations None needs --max-seconds"):
        limited_as_given(TrainConfig(max_num_iterations=None), {"max_num_iterations"})


def test_flags_recipes_and_runs_say_what_is_given(tiny: Path, tmp_path: Path) -> None:
    """A method's number of steps is a default; a value in a file or a flag is not, even if it is the same."""

    def limits(run: Run) -> tuple[int | None, float | None]:
        return run.config.max_num_iterations, run.config.max_seconds

    data = ["--data", str(tiny)]
    assert limits(run_of("instant-ngp", data)) == (20_000, None)
    assert limits(run_of("instant-ngp", [*data, "--max-seconds", "60"])) == (None, 60.0)
    assert limits(run_of("instant-ngp", [*data, "--max_seconds=60", "--max-num-iterations=20000"])) == (20_000, 60.0)
    recipe = tmp_path / "recipe.yml"
    recipe.write_text(f"method: instant-ngp\ndata: {tiny}\nmax_seconds: 60\n")
    assert limits(read_run(recipe)) == (None, 60.0)
    recipe.write_text(f"method: instant-ngp\ndata: {tiny}\nmax_seconds: 60\nmax_num_iterations: 20000\n")
    assert limits(read_run(recipe)) == (20_000, 60.0)
    run = run_of("instant-ngp", [*data, "--max-seconds", "60", "--output-dir", str(tmp_path)])
    create_folder(run)
    assert limits(read_run(run.folder)) == (None, 60.0)


def test_an_evaluation_takes_half_of_the_training_at_most_unless_all_images_are_asked_for() -> None:
    assert evaluation_seconds(TrainConfig(), State(seconds=60.0)) == 30
    assert evaluation_seconds(TrainConfig(), State(seconds=1.0)) == 10
    assert evaluation_seconds(TrainConfig(eval="all"), State(seconds=60.0)) is None
