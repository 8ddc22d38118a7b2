"""The sharpest frame of each interval."""

import numpy as np
import pytest

from framework.tools.processing.video import sharpest, sharpness


def frame(blur: int, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 255, (40, 60, 3)).astype(np.float64)
    for _ in range(blur):
        noise = (noise + np.roll(noise, 1, 0) + np.roll(noise, 1, 1)) / 3
    return noise.astype(np.uint8)


def test_blur_lowers_sharpness() -> None:
    found = [sharpness(frame(blur)) for blur in range(4)]
    assert found == sorted(found, reverse=True)
    assert sharpness(np.zeros((2, 2, 3), np.uint8)) == 0


@pytest.mark.parametrize(("count", "target", "taken"), [(12, 4, 4), (3, 10, 3), (0, 5, 0), (10, 3, 3)])
def test_one_frame_an_interval(count: int, target: int, taken: int) -> None:
    assert len(list(sharpest((frame(1, index) for index in range(count)), count, target))) == taken


def test_the_sharpest_is_taken() -> None:
    blurs = [2, 0, 3, 1, 3, 2]
    frames = [frame(blur, index) for index, blur in enumerate(blurs)]
    chosen = list(sharpest(frames, 6, 2))
    assert np.array_equal(chosen[0], frames[1])
    assert np.array_equal(chosen[1], frames[3])
