"""Features of given pairs compared in numpy, for versions of pycolmap that only compare all pairs (before 4)."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from functools import lru_cache
from pathlib import Path

import numpy as np

from framework.tools.processing.retrieval import read_descriptors

MAX_RATIO = 0.8
"""The nearest feature's angle over the second nearest's, at most (Lowe 2004)."""
MAX_ANGLE = 0.7
"""Radians between matching features, at most."""
_PAIR_BASE = 2147483647
"""COLMAP numbers the pair of images i < j as this times i plus j."""


def match(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Features of two photographs that are each other's nearest, and clearly nearer than the next.

    Args:
        first, second: (K, D) and (L, D) uint8 descriptors.
    Returns: (M, 2) uint32 indices into both.
    """
    if len(first) < 2 or len(second) < 2:
        return np.zeros((0, 2), np.uint32)
    cosines = _unit(first) @ _unit(second).T
    there, back = _clearly_nearest(cosines), _clearly_nearest(cosines.T)
    kept = np.flatnonzero((there >= 0) & (back[there] == np.arange(len(first))))
    return np.stack([kept, there[kept]], axis=1).astype(np.uint32)


def write_matches(report: Callable[[int], None], database: Path, pairs: list[tuple[str, str]]) -> None:
    """Match pairs of photographs, by name, into COLMAP's database; COLMAP's verification is to follow."""

    @lru_cache(maxsize=64)
    def features(name: str) -> np.ndarray:
        return read_descriptors(database, [name])[0]

    with closing(sqlite3.connect(database)) as connection:
        identities = dict(connection.execute("SELECT name, image_id FROM images"))
        for index, (first, second) in enumerate(pairs):
            if identities[first] > identities[second]:
                first, second = second, first
            matches = match(features(first), features(second))
            number = identities[first] * _PAIR_BASE + identities[second]
            row = (number, *matches.shape, matches.tobytes())
            connection.execute("INSERT OR REPLACE INTO matches(pair_id, rows, cols, data) VALUES(?, ?, ?, ?)", row)
            report(index + 1)
        connection.commit()


def _unit(descriptors: np.ndarray) -> np.ndarray:
    exact = descriptors.astype(np.float32)
    return exact / np.maximum(np.linalg.norm(exact, axis=1, keepdims=True), 1e-12)


def _clearly_nearest(cosines: np.ndarray) -> np.ndarray:
    """(K,) for each row of (K, L) the column with the smallest angle, -1 where it is too large or not clearly so."""
    rows = np.arange(len(cosines))
    best = cosines.argmax(axis=1)
    angle = np.arccos(np.clip(cosines[rows, best], -1, 1))
    without = cosines.copy()
    without[rows, best] = -1
    second = np.arccos(np.clip(without.max(axis=1), -1, 1))
    return np.where((angle <= MAX_ANGLE) & (angle <= MAX_RATIO * second), best, -1)
