"""How much is drawn at once: a stride that does not swing, pieces that cover a picture, a share of the time."""

import random
from itertools import pairwise

import pytest

from nerfloom.viewer.pace import (
    MIN_ROWS,
    STRIDES,
    Share,
    Speed,
    Waiting,
    coarse_stride,
    next_browser,
    refinement,
)
from nerfloom.viewer.request import smaller

WIDTH, HEIGHT, BUDGET = 1024, 600, 0.1


def size(stride: int) -> int:
    width, height = smaller(WIDTH, HEIGHT, stride)
    return width * height


@pytest.mark.parametrize("fixed", [0.0, 0.01, 0.05])
@pytest.mark.parametrize("each", [1e-8, 2e-6, 1e-5, 3e-4])
def test_the_stride_settles_and_stays(fixed: float, each: float) -> None:
    """A machine's pictures take a fixed time and one per pixel, give or take a fifth."""
    generator, speed, stride = random.Random(0), Speed(), None
    strides = []
    for _ in range(60):
        stride = coarse_stride(speed, WIDTH, HEIGHT, BUDGET, stride)
        seconds = (fixed + each * size(stride)) * generator.uniform(0.8, 1.2)
        speed = speed.with_one(size(stride), seconds)
        strides.append(stride)
    assert len(set(strides[8:])) == 1, strides
    settled = fixed + each * size(strides[-1])
    assert settled <= 1.5 * BUDGET or strides[-1] == STRIDES[-1]
    finer = [one for one in STRIDES if one < strides[-1]]
    if finer:  # a finer stride would not have been much too fast either
        assert fixed + each * size(finer[-1]) > 0.4 * BUDGET


def test_the_stride_follows_a_machine_that_becomes_slower() -> None:
    speed, stride = Speed(), None
    for each in [2e-6] * 20 + [2e-5] * 40:
        stride = coarse_stride(speed, WIDTH, HEIGHT, BUDGET, stride)
        speed = speed.with_one(size(stride), each * size(stride))
    assert stride is not None
    assert 2e-5 * size(stride) < 1.5 * BUDGET


def test_the_speed_is_a_line_through_what_was_measured() -> None:
    speed = Speed()
    for rays in (1_000, 5_000, 20_000):
        speed = speed.with_one(rays, 0.02 + 1e-6 * rays)
    assert speed.seconds(100_000) == pytest.approx(0.12, rel=1e-6)
    assert speed.rays(0.12) == pytest.approx(100_000, rel=1e-6)
    assert Speed().with_one(1000, 0.01).seconds(2000) == pytest.approx(0.02)


@pytest.mark.parametrize("shown", [1, 2, 3, 8, 24])
@pytest.mark.parametrize("rays", [1, 4])
def test_every_pass_covers_the_picture_once(shown: int, rays: int) -> None:
    speed = Speed().with_one(1_000, 0.004)
    pieces = refinement(speed, WIDTH, HEIGHT, shown, rays, 0.1)  # type: ignore[arg-type]
    passes: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for piece in pieces:
        passes.setdefault((piece.stride, piece.rays), []).append((piece.top, piece.bottom))
        pixels = smaller(WIDTH, HEIGHT, piece.stride)[0] * (piece.bottom - piece.top) * piece.rays
        assert speed.seconds(pixels) <= 0.11 or piece.bottom - piece.top <= MIN_ROWS
    for (stride, _), bands in passes.items():
        rows = sorted(bands)
        assert rows[0][0] == 0
        assert rows[-1][1] == smaller(WIDTH, HEIGHT, stride)[1]
        assert all(a[1] == b[0] for a, b in pairwise(rows))
    assert list(passes)[-1] == (1, rays)
    assert [stride for stride, _ in passes] == sorted((stride for stride, _ in passes), reverse=True)


def test_the_share_of_the_time_is_kept() -> None:
    generator, share = random.Random(1), Share(0.1)
    steps = pictures = 0.0
    for _ in range(5_000):
        step = generator.uniform(0.005, 0.04)
        steps, share = steps + step, share.earned(step)
        while share.credit > 0:
            picture = generator.uniform(0.01, 0.2)
            pictures, share = pictures + picture, share.spent(picture)
    assert pictures / (pictures + steps) == pytest.approx(0.1, abs=0.003)


def test_what_is_not_used_does_not_pile_up() -> None:
    assert Share(0.1).earned(3600).credit == Share(0.1).most


def test_new_requests_come_first_and_in_turn() -> None:
    rough = Waiting(new=False, rough=True, asked_at=0, served_at=0)
    first = Waiting(new=True, rough=True, asked_at=9.9, served_at=5)
    second = Waiting(new=True, rough=False, asked_at=9.8, served_at=4)
    assert next_browser([rough, first, second], 10, 0.2) == 2
    assert next_browser([rough, first], 10, 0.2) == 1
    moving = Waiting(new=False, rough=True, asked_at=9.9, served_at=0)
    assert next_browser([moving], 10, 0.2) is None  # its camera still moves
    assert next_browser([moving, rough], 10, 0.2) == 1
    assert next_browser([], 10, 0.2) is None
