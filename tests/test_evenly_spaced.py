"""Some of many, equally far apart: against whole-number arithmetic, also beyond the range that float32 can count."""

from __future__ import annotations

import pytest
import torch

from nerfloom.base.evenly_spaced import evenly_spaced


@pytest.mark.parametrize(("count", "most"), [(0, 5), (1, 5), (5, 5), (5, 9), (7, 3), (10, 4), (2**31 + 12, 7)])
def test_indices_are_the_whole_parts_of_equal_steps(count: int, most: int) -> None:
    number = min(count, most)
    truth = [i * (count - 1) // max(number - 1, 1) for i in range(number)]
    found = evenly_spaced(count, most)
    assert found.dtype == torch.int64
    assert found.tolist() == truth


def test_the_last_of_many_pixels_is_the_last() -> None:
    """float32 holds no 2^24 + 1, and would give the pixel before."""
    assert evenly_spaced(2**24 + 2, 3)[-1] == 2**24 + 1
