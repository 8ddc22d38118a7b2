"""The number of rays of a step, by samples and by time."""

import dataclasses
import math

import pytest

from nerfloom.base.config import RayConfig
from nerfloom.base.pace import Pace
from nerfloom.training.batch_size import BATCH_CHANGES, MAX_BATCH, MIN_BATCH, BatchSize

CONFIG = RayConfig(num_rays_per_batch=2_048)


def steps(config: RayConfig, budget: float, fixed: float, each: float, slower: float = 1.0) -> list[int]:
    """Return the rays of each step of a run.

    Args:
        config: settings.
        budget: seconds of the run.
        fixed: seconds of a step without rays.
        each: seconds of a ray.
        slower: ratio of all times in the second half of the run to the times in the first.
    """
    sizes, seconds, rays = BatchSize(config, recorded=False), 0.0, []
    while seconds < budget:
        sizes.keep_pace(Pace(len(rays), seconds, budget))
        rays.append(sizes.rays(None, math.nan))
        seconds += (fixed + each * rays[-1]) * (slower if seconds > budget / 2 else 1.0)
    return rays


@pytest.mark.parametrize("each", [3e-5, 1e-3])
def test_there_are_as_many_steps_as_rays_in_one(each: float) -> None:
    rays = steps(CONFIG, 60.0, 0.005, each)
    assert rays[0] == MIN_BATCH  # as it is not known how long a step takes
    usual = rays[len(rays) // 2]
    assert len(rays) / usual == pytest.approx(CONFIG.steps_per_ray, rel=0.1)


def test_a_quick_machine_has_all_rays_and_a_very_slow_one_a_few() -> None:
    assert steps(CONFIG, 60.0, 1e-4, 1e-6)[-1] == 2_048
    assert steps(CONFIG, 60.0, 0.1, 0.05)[-1] == MIN_BATCH
    assert set(steps(dataclasses.replace(CONFIG, num_rays_per_batch=16), 60.0, 0.1, 0.05)) == {16}


def test_rays_follow_a_machine_that_becomes_slower() -> None:
    rays = steps(CONFIG, 60.0, 0.0, 3e-5, slower=4.0)
    assert rays[-1] == pytest.approx(rays[len(rays) // 3] / 2, rel=0.05)  # the square root of a quarter


def test_rays_that_are_given_stay() -> None:
    assert set(steps(dataclasses.replace(CONFIG, steps_per_ray=0.0), 60.0, 0.1, 0.05)) == {2_048}


def test_times_are_read_where_the_device_is_waited_for() -> None:
    sizes = BatchSize(CONFIG, recorded=False)
    for step in range(60):  # nine steps return at once, the tenth waits for all: 0.01 s each
        sizes.keep_pace(Pace(step, step // 10 * 0.1, 60.0, steps_per_read=10))
        sizes.rays(None, math.nan)
    assert sizes.rays(None, math.nan) > 2 * MIN_BATCH


def test_samples_decide_where_they_are_given() -> None:
    sizes = BatchSize(CONFIG, recorded=False)
    sizes.keep_pace(Pace(0, 0.0, 60.0))
    assert sizes.rays(2**15, 32.0) == 1_024
    assert sizes.rays(2**15, 1e9) == MIN_BATCH
    assert sizes.rays(2**30, 0.0) == MAX_BATCH


def test_recorded_steps_keep_their_size_for_small_changes() -> None:
    sizes = BatchSize(CONFIG, recorded=True)
    sizes.keep_pace(Pace(0, 0.0, 60.0))
    assert sizes.rays(None, math.nan) == 2_048
    assert sizes.rays(2_048 * 10, 10 * BATCH_CHANGES**0.5) == 2_048
    assert sizes.rays(2_048 * 10, 10 * BATCH_CHANGES**2) < 1_500
