"""Images of reduced sizes, and when training goes on to the next larger size."""

import pytest
import torch

from nerfloom.base.pace import Pace
from nerfloom.splats.resolution import (
    MIN_SIDE,
    REDUCED_SHARE,
    ImageSizes,
    enlarged,
    halved,
    halved_distances,
    most_octaves,
    octaves_at,
    reduced,
    reduced_weights,
    share_for,
)


def test_a_half_image_is_the_mean_of_four_and_doubles_back() -> None:
    image = torch.arange(5 * 6 * 3, dtype=torch.float32).view(5, 6, 3)
    half = halved(image)
    assert half.shape == (2, 3, 3)
    torch.testing.assert_close(half[1, 2], image[2:4, 4:6].reshape(4, 3).mean(0))
    whole = enlarged(half, image, 1)
    assert torch.equal(whole[4], image[4])  # an odd last row stays
    torch.testing.assert_close(halved(whole), half)
    assert enlarged(image, image, 0) is image


def test_halving_twice_is_the_mean_of_sixteen() -> None:
    image = torch.rand(9, 13, 2, dtype=torch.float64)
    small = reduced(image, 2)
    assert small.shape == (2, 3, 2)
    torch.testing.assert_close(small[1, 2], image[4:8, 8:12].reshape(16, 2).mean(0))
    assert enlarged(small, image, 2).shape == image.shape


def test_distances_are_not_mixed_and_no_known_one_is_lost() -> None:
    distances = torch.tensor([[0.0, 3.0, 5.0, 2.0, 9.0], [0.0, 0.0, 0.0, 4.0, 9.0], [0.0, 0.0, 0.0, 0.0, 7.0]])
    assert halved_distances(distances).tolist() == [[3.0, 2.0]]
    assert halved_distances(torch.zeros(4, 4)).tolist() == [[0.0, 0.0], [0.0, 0.0]]


def test_a_mean_of_pixels_has_the_least_of_their_weights() -> None:
    weights = torch.rand(9, 13, generator=torch.Generator().manual_seed(0))
    assert reduced_weights(weights, 0) is weights
    small = reduced_weights(weights, 2)
    assert small.shape == (2, 3)
    assert float(small[1, 2]) == float(weights[4:8, 8:12].min())


def test_each_size_has_as_much_time_as_all_smaller_ones() -> None:
    steps = [octaves_at((i + 0.5) / 1000, 0.4, 3) for i in range(1000)]
    assert steps == sorted(steps, reverse=True)
    assert [steps.count(octaves) for octaves in (3, 2, 1, 0)] == [100, 100, 200, 600]
    assert {octaves_at(i / 1000, 0.4, 1) for i in range(400)} == {1}
    assert octaves_at(0.0, 0.0, 3) == 0


def test_images_are_not_halved_to_a_stamp() -> None:
    for side in (50, 299, 301, 601, 1201, 5000):
        most = most_octaves(side**2)
        assert most == 1 or side / 2**most >= MIN_SIDE
        assert side / 2 ** (most + 1) < MIN_SIDE


def test_fewer_steps_at_full_size_leave_more_time_for_small_ones() -> None:
    shares = [share_for(steps) for steps in (10_000, 1000, 300, 100, 10, 0)]
    assert shares[0] == pytest.approx(REDUCED_SHARE)
    assert shares == sorted(shares)
    assert shares[-1] <= 0.95


def run(sizes: ImageSizes, seconds_of: dict[int, float], budget: float) -> list[int]:
    """Return the octaves of each step of a run; a step takes the seconds of its octaves."""
    step, seconds, taken = 0, 0.0, []
    while seconds < budget:
        sizes.learn(Pace(step, seconds, budget))
        octaves = sizes.next(seconds / budget)
        taken.append(octaves)
        seconds += seconds_of[octaves]
        step += 1
    return taken


def test_slow_steps_are_found_out_and_most_of_the_run_is_at_small_sizes() -> None:
    slow_steps = {0: 0.8, 1: 0.2, 2: 0.05, 3: 0.02}
    quick = run(ImageSizes(REDUCED_SHARE, 3, True), {0: 0.04, 1: 0.02, 2: 0.01, 3: 0.01}, 60.0)
    slow = run(ImageSizes(REDUCED_SHARE, 3, True), slow_steps, 60.0)
    fixed = run(sizes := ImageSizes(REDUCED_SHARE, 3, False), slow_steps, 60.0)
    assert quick.count(0) * 0.04 == pytest.approx(36, abs=0.5)
    assert slow[:2] == [0, 0]  # measured at full size before anything is decided
    assert set(slow) == {0, 1, 2, 3}
    assert len(slow) > 1.4 * len(fixed)
    assert slow.count(0) * 0.8 >= 0.1 * 60 - 1.6  # full size keeps its least share
    assert fixed[0] == 3
    assert sizes.steps == {octaves: fixed.count(octaves) for octaves in range(4)}


def test_a_method_that_asks_for_no_size_has_the_times_of_whole_images() -> None:
    sizes = ImageSizes(REDUCED_SHARE, 3, True)
    for step in range(4):
        sizes.learn(Pace(step, 0.5 * step, 60.0))
    assert sizes.steps.total() == 0
    assert sizes.share == pytest.approx(share_for(120))


def test_small_images_stay_as_they_are() -> None:
    assert set(run(ImageSizes(0.0, 1, True), {0: 1.0}, 60.0)) == {0}


def test_a_run_that_becomes_slower_waits_longer_for_full_size() -> None:
    """Another program starts after the sizes were measured: all steps take four times as long from then on."""
    sizes, step, seconds = ImageSizes(REDUCED_SHARE, 3, True), 0, 0.0
    shares = []
    while seconds < 60:
        sizes.learn(Pace(step, seconds, 60.0))
        octaves = sizes.next(seconds / 60)
        shares.append(sizes.share)
        seconds += {0: 0.08, 1: 0.04, 2: 0.02, 3: 0.01}[octaves] * (1 if seconds < 6 else 4)
        step += 1
    assert shares[10] < 0.5
    assert shares[-1] > 0.6


def test_steps_to_come_are_counted_at_the_times_of_their_sizes() -> None:
    """The number expected after each size has been measured is the number of the rest of the run."""
    sizes, seconds_of = ImageSizes(REDUCED_SHARE, 3, True), {0: 0.08, 1: 0.04, 2: 0.02, 3: 0.01}
    assert sizes.steps_until(Pace(0, 0.0, 60.0), 0.8) is None
    run(sizes, seconds_of, 60.0)
    at = Pace(1000, 0.25 * 60, 60.0)
    assert at.progress < sizes.share
    progress, steps = at.progress, 0
    while progress < 0.8:
        octaves = octaves_at(progress, sizes.share, 3)
        progress += seconds_of[octaves] / 60
        steps += 1
    assert sizes.steps_until(at, 0.8) == pytest.approx(steps, abs=2)
    assert sizes.steps_until(Pace(1, 59.0, 60.0), 0.8) == 0.0
