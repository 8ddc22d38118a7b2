"""Intervals without end: every density over an infinite length, as the last interval of an endless ray is."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.kernels.test_compositing import EXTREMES
from tests.stress.backends import FEW, backends
from tests.stress.test_intervals import Ray, by_hand, composited, each_function, packed, weights_along

EMPTY = (0.0, math.inf)
"""Has a test of its own (`test_empty_space_without_end_has_no_weight`)."""
INTERVAL = st.tuples(st.sampled_from(EXTREMES), st.sampled_from(EXTREMES)).filter(lambda interval: interval != EMPTY)


@pytest.mark.entry(8)
@backends()
@FEW
@given(rays=st.lists(st.lists(INTERVAL, max_size=6), max_size=4))
def test_any_density_over_any_length(backend: str, rays: list[Ray]) -> None:
    samples, sigma = packed(rays)
    found = composited(samples, sigma)
    ends = samples.offsets.tolist()
    for index, ray in enumerate(rays):
        weights, _ = by_hand(ray)
        assert found.weights[ends[index] : ends[index + 1]].tolist() == pytest.approx(weights, rel=1e-4, abs=1e-37)
        assert found.color[index].tolist() == pytest.approx([1 - 0.75 * math.fsum(weights)] * 3, abs=1e-4)


@pytest.mark.entry(8, 14)
@backends()
@each_function
@pytest.mark.parametrize("density", EXTREMES[1:])
def test_an_endless_last_interval_takes_what_is_left(backend: str, function: str, density: float) -> None:
    """However thin it is, there is enough of it."""
    weights = weights_along(function, torch.tensor([0.5, density]), torch.tensor([0.0, 1.0, math.inf]))
    assert weights.tolist() == pytest.approx([-math.expm1(-0.5), math.exp(-0.5)], rel=1e-4)
