"""Matching of given pairs in numpy, for versions of pycolmap that can only match all pairs (before 4)."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from functools import lru_cache
from pathlib import Path

import numpy as np

from nerfloom.processing.database import PAIR_BASE
from nerfloom.processing.retrieval import read_descriptors

MAX_RATIO = 0.8
"""Maximum ratio of the nearest feature's angle to the second nearest's (Lowe 2004)."""
MAX_ANGLE = 0.7
"""Maximum angle between matching features, radians."""


def match(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the features of two images that are mutual nearest neighbours by a clear margin.

    Args:
        first: (K, D) uint8 descriptors.
        second: (L, D) uint8 descriptors.

    Returns:
        (M, 2) uint32 indices into both.
    """
    if len(first) < 2 or len(second) < 2:
        return np.zeros((0, 2), np.uint32)
    cosines = _unit(first) @ _unit(second).T
    forward, backward = _clearly_nearest(cosines), _clearly_nearest(cosines.T)
    mutual = np.flatnonzero((forward >= 0) & (backward[forward] == np.arange(len(first))))
    return np.stack([mutual, forward[mutual]], axis=1).astype(np.uint32)


def write_matches(database: Path, pairs: list[tuple[str, str]]) -> None:
    """Match `pairs` of names by features in COLMAP's `database`, and write the matches there, for COLMAP to verify."""

    @lru_cache(maxsize=64)
    def features(name: str) -> np.ndarray:
        return read_descriptors(database, [name])[0]

    with closing(sqlite3.connect(database)) as connection:
        identities = dict(connection.execute("SELECT name, image_id FROM images"))
        for first, second in pairs:
            if identities[first] > identities[second]:
                first, second = second, first
            matches = match(features(first), features(second))
            number = identities[first] * PAIR_BASE + identities[second]
            row = (number, *matches.shape, matches.tobytes())
            connection.execute("INSERT OR REPLACE INTO matches(pair_id, rows, cols, data) VALUES(?, ?, ?, ?)", row)
        connection.commit()


def _unit(descriptors: np.ndarray) -> np.ndarray:
    values = descriptors.astype(np.float32)
    return values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-12)


def _clearly_nearest(cosines: np.ndarray) -> np.ndarray:
    """Return the column with the smallest angle for each row of (K, L), or -1 if it is too large or ambiguous."""
    rows = np.arange(len(cosines))
    best = cosines.argmax(axis=1)
    angle = np.arccos(np.clip(cosines[rows, best], -1, 1))
    without = cosines.copy()
    without[rows, best] = -1
    second = np.arccos(np.clip(without.max(axis=1), -1, 1))
    return np.where((angle <= MAX_ANGLE) & (angle <= MAX_RATIO * second), best, -1)
