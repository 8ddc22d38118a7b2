"""A short tour through points, as an order for a video that passes cameras.

It is found by 2-opt moves (Croes 1958, "A method for solving traveling-salesman problems"), and each move reverses a
part of the tour. They start from the shorter of two tours: the given order, and the one that goes on to the nearest
point that is left.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

MAX_SWEEPS = 100
"""Maximum number of rounds; each round tries all edges of a tour."""
LEAST_GAIN = 1e-9
"""A move counts if it shortens the tour by more than this fraction of its length."""


def tour(points: Tensor, closed: bool = True) -> Tensor:
    """Return the order of a short tour that visits each point once. It is never longer than the given order.

    Args:
        points: (M, D) positions, at least one.
        closed: whether the tour returns to its first point.

    Returns:
        (M,) int64 indices of the points. A closed tour starts at the first one.
    """
    count = len(points)
    places, weights = points.double().cpu().numpy(), np.ones(count)
    if not closed:  # a last point, at distance 0 from all others, joins the ends
        places, weights = np.concatenate([places, places[:1]]), np.append(weights, 0.0)
    given = np.arange(len(places))
    nearest = np.concatenate([_by_nearest(places[:count]), given[count:]])
    order = min((given, nearest), key=lambda one: _lengths(places, weights, one, np.roll(one, -1)).sum())
    order = _improved(places, weights, order)
    start = np.flatnonzero(order == (0 if closed else count))[0]
    found = np.roll(order, -start)[len(order) - count :]
    if found[-1] < found[0] or (closed and count > 2 and found[-1] < found[1]):  # one of the two directions
        found = np.roll(found[::-1], int(closed))
    return torch.from_numpy(found.astype(np.int64))


def _by_nearest(places: np.ndarray) -> np.ndarray:
    """Return the tour from the first point that goes on to the nearest of the points that are left."""
    left = np.ones(len(places), bool)
    order = [0]
    for _ in range(len(places) - 1):
        left[order[-1]] = False
        away = np.linalg.norm(places - places[order[-1]], axis=1)
        order.append(int(np.where(left, away, np.inf).argmin()))
    return np.array(order)


def _lengths(places: np.ndarray, weights: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the lengths of edges from points `start` to points `end`; 0 for a point of weight 0."""
    return np.linalg.norm(places[start] - places[end], axis=-1) * weights[start] * weights[end]


def _improved(places: np.ndarray, weights: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Return a closed tour after 2-opt moves, until none of them shortens it."""
    least = LEAST_GAIN * float(_lengths(places, weights, order, np.roll(order, -1)).sum())
    for _ in range(MAX_SWEEPS):
        shortened = False
        for i in range(len(order) - 2):
            # Edges (i, i + 1) and (j, j + 1) become (i, j) and (i + 1, j + 1).
            first, second = order[i], order[i + 1]
            others, after = order[i + 2 :], np.append(order[i + 3 :], order[0])
            before = _lengths(places, weights, first, second) + _lengths(places, weights, others, after)
            change = _lengths(places, weights, first, others) + _lengths(places, weights, second, after) - before
            j = int(change.argmin())
            if change[j] < -least:
                order = np.concatenate([order[: i + 1], order[i + 1 : i + 3 + j][::-1], order[i + 3 + j :]])
                shortened = True
        if not shortened:
            break
    return order
