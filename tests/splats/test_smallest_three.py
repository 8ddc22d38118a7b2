"""Quaternions by three of their components, and back."""

import numpy as np

from nerfloom.splats.smallest_three import joined, split


def test_what_is_split_is_joined_up_to_sign() -> None:
    random = np.random.default_rng(0)
    given = np.concatenate([random.normal(size=(200, 4)), np.eye(4), -np.eye(4)])
    place, others = split(given)
    assert np.abs(others).max() <= np.sqrt(0.5) + 1e-12
    unit = given / np.linalg.norm(given, axis=1, keepdims=True)
    np.testing.assert_array_equal(place, np.abs(unit).argmax(1))
    read = joined(place, others)
    np.testing.assert_allclose(np.abs((read * unit).sum(1)), 1, rtol=0, atol=1e-12)
    assert (np.take_along_axis(read, place[:, None], 1) > 0).all()


def test_components_stay_in_their_order() -> None:
    read = joined(np.array([0, 2]), np.array([[0.1, 0.2, -0.3], [0.1, 0.2, -0.3]]))
    largest = np.sqrt(1 - 0.14)
    np.testing.assert_allclose(read, [[largest, 0.1, 0.2, -0.3], [0.1, 0.2, largest, -0.3]])
    assert joined(np.array([3]), np.ones((1, 3))).tolist() == [[1, 1, 1, 0]]  # too long for a largest component
