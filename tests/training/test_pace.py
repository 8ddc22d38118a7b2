"""Timed steps, and measured speeds of machines."""

import dataclasses

import pytest
import torch

from nerfloom.base.config import TrainConfig
from nerfloom.base.device import relative_speed
from nerfloom.base.errors import ConfigError
from nerfloom.base.machine_config import MachineConfig
from nerfloom.base.pace import Pace, StepTimes
from nerfloom.training import speed


def learnt(times: StepTimes, steps: list[tuple[int, float]], steps_per_read: int = 1) -> None:
    """Show the times of steps, each a size and seconds."""
    now = Pace(0, 0.0, 100.0, steps_per_read)
    times.learn(now, 0)
    for size, seconds in steps:
        now = Pace(now.step + 1, now.seconds + seconds, 100.0, steps_per_read)
        times.learn(now, size)


def test_a_size_has_the_time_of_its_own_steps_without_the_first() -> None:
    times = StepTimes()
    learnt(times, [(0, 9.0), (0, 0.5), (2, 0.125), (2, 0.125)])
    assert times.of(0) == pytest.approx(0.5)
    assert times.of(2) == pytest.approx(0.125)
    assert times.of(1) is None


def test_what_slows_one_size_slows_all() -> None:
    times = StepTimes()
    learnt(times, [(0, 9.0), (0, 0.5), (2, 0.125), *[(2, 0.25)] * 200])
    assert times.of(2) == pytest.approx(0.25, rel=1e-3)
    assert times.of(0) == pytest.approx(1.0, rel=1e-3)


def test_times_are_measured_over_several_steps_where_one_says_little() -> None:
    """A device that computes on its own returns from nine steps at once and is waited for in the tenth."""
    times = StepTimes()
    learnt(times, [(0, seconds) for _ in range(3) for seconds in (*[0.0] * 9, 1.0)], steps_per_read=10)
    assert times.of(0) == pytest.approx(0.1)


def test_no_more_than_all_of_a_budget_is_spent() -> None:
    assert Pace(3, 2.0, 5.0).progress == 0.4
    assert Pace(3, 7.0, 5.0).progress == 1.0


@pytest.mark.parametrize(("seconds", "told"), [(1.0, None), (1.3, None), (3.0, 0.33), (0.25, 4.0)])
def test_a_speed_counts_if_it_is_unusual(seconds: float, told: float | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    monkeypatch.setattr(speed, "step_seconds", lambda: seconds * speed.REFERENCE_SECONDS)
    config = TrainConfig(max_seconds=10.0, machine=MachineConfig(device_type="cpu"))
    found, made = speed.with_speed(config)
    assert found.machine.speed == told
    assert relative_speed(found.machine) == (told or 1.0)
    assert len(made) == (told is not None)
    for other in (
        dataclasses.replace(config, max_seconds=None),
        dataclasses.replace(config, max_seconds=speed.MIN_BUDGET / 2),
        dataclasses.replace(config, machine=MachineConfig(device_type="cpu", speed=2.5)),
    ):
        assert speed.with_speed(other) == (other, [])


def test_the_measurement_leaves_random_numbers_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed, "MEASURING_SECONDS", 0.0)
    torch.manual_seed(3)
    expected = torch.rand(4)
    torch.manual_seed(3)
    assert speed.step_seconds() > 0
    assert torch.equal(torch.rand(4), expected)


def test_a_speed_is_more_than_nothing() -> None:
    with pytest.raises(ConfigError, match="more than 0"):
        MachineConfig(speed=0.0)
