"""Tours through points: each point once, against brute force and the order that is given."""

import itertools
import math

import pytest
import torch
from torch import Tensor

from nerfloom.evaluation.tour import tour


def length(points: Tensor, order: list[int], closed: bool) -> float:
    """Length of a way through points, and back to the first if it is closed."""
    way = points[torch.tensor([*order, *order[:1]] if closed else order)]
    return float((way[1:] - way[:-1]).norm(dim=-1).sum())


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("count", [1, 2, 3, 4, 6, 40])
def test_each_point_is_visited_once_and_no_way_is_longer_than_the_given_one(count: int, closed: bool) -> None:
    for seed in range(5):
        points = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        order = tour(points, closed).tolist()
        assert sorted(order) == list(range(count))
        assert length(points, order, closed) <= length(points, list(range(count)), closed) + 1e-9
        if closed:
            assert order[0] == 0


@pytest.mark.parametrize("closed", [True, False])
def test_three_points_are_visited_in_the_best_order(closed: bool) -> None:
    for seed in range(10):
        points = torch.rand(3, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        best = min(length(points, list(order), closed) for order in itertools.permutations(range(3)))
        assert length(points, tour(points, closed).tolist(), closed) == pytest.approx(best)


def test_points_of_a_line_and_of_a_circle_are_visited_in_their_order() -> None:
    draws = torch.Generator().manual_seed(1)
    shuffled = torch.randperm(20, generator=draws)
    line = tour(shuffled[:, None].double(), closed=False)
    assert shuffled[line].tolist() in (list(range(20)), list(range(19, -1, -1)))
    angles = shuffled * (2 * math.pi / 20)
    circle = torch.stack([angles.cos(), angles.sin()], -1).double()
    assert length(circle, tour(circle).tolist(), True) == pytest.approx(40 * math.sin(math.pi / 20), rel=1e-6)


def test_a_walk_in_two_rounds_with_shuffled_names_is_shortened() -> None:
    """Photographs of two rounds at two heights, named at random: the tour passes neighbours, not names."""
    angles = torch.arange(60, dtype=torch.float64) * (2 * math.pi / 30)
    walk = torch.stack([angles.cos(), angles.sin(), 0.5 * (torch.arange(60) >= 30).double()], -1)
    walk = walk[torch.randperm(60, generator=torch.Generator().manual_seed(2))]
    found = length(walk, tour(walk).tolist(), True)
    assert found < 0.25 * length(walk, list(range(60)), True)
    rounds = 2 * 30 * 2 * math.sin(math.pi / 30) + 2 * 0.5  # both rounds, and up and down between them
    assert found < 1.1 * rounds
