"""Which photographs are compared."""

import numpy as np

from nerfloom.processing.pair_matching import match
from nerfloom.processing.retrieval import all_pairs, global_descriptors, sequential_pairs, similar_pairs


def test_all_and_neighbouring_pairs() -> None:
    assert all_pairs(3) == [(0, 1), (0, 2), (1, 2)]
    pairs = sequential_pairs(40, 3)
    assert {j - i for i, j in pairs} == {1, 2, 3, 4}
    assert len(pairs) == 39 + 38 + 37 + 36


def test_photographs_of_the_same_place_are_found() -> None:
    """Three places with their own features, and four photographs of each; a photograph shows a random half."""
    draws = np.random.default_rng(0)
    places = [draws.integers(0, 255, (300, 128)).astype(np.uint8) for _ in range(3)]
    photographs = [places[i % 3][draws.permutation(300)[:150]] for i in range(12)]
    pairs = similar_pairs(global_descriptors(photographs), 3)
    assert {(i % 3, j % 3) for i, j in pairs} == {(0, 0), (1, 1), (2, 2)}
    assert len(pairs) == 3 * 6


def test_a_photograph_without_features_is_in_no_pair() -> None:
    draws = np.random.default_rng(0)
    photographs = [draws.integers(0, 255, (50, 128)).astype(np.uint8) for _ in range(3)] + [
        np.zeros((0, 128), np.uint8)
    ]
    assert similar_pairs(global_descriptors(photographs), 5) == [(0, 1), (0, 2), (1, 2)]
    assert global_descriptors([]).shape[0] == 0


def test_features_match_their_noisy_selves() -> None:
    draws = np.random.default_rng(0)
    first = draws.integers(0, 120, (200, 128)).astype(np.uint8)
    order = draws.permutation(200)
    noisy = np.clip(first[order].astype(int) + draws.integers(-3, 4, (200, 128)), 0, 255).astype(np.uint8)
    found = match(first, noisy)
    assert len(found) > 150
    assert np.array_equal(order[found[:, 1]], found[:, 0])
