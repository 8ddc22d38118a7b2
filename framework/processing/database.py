"""COLMAP's database: features of images, and matches of pairs. Another process may be writing to it."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np

PAIR_BASE = 2**31 - 1
"""COLMAP's number of a pair of images i < j is this number times i, plus j."""


def rows(database: Path, table: str, what: str = "COUNT(*)") -> int:
    """Return a number `what` from a `table` of the `database`; 0 if it is unreadable at the moment."""
    if not database.is_file():
        return 0
    try:
        with closing(_opened(database)) as opened:
            return int(opened.execute(f"SELECT {what} FROM {table}").fetchone()[0] or 0)
    except sqlite3.Error:
        return 0


def features(database: Path) -> dict[str, int]:
    """Return the number of features of each image in the `database`, by name."""
    query = "SELECT name, rows FROM images JOIN descriptors USING (image_id)"
    return dict(_read(database, query))


def camera_of(database: Path, names: list[str]) -> int | None:
    """Return the camera number, in `database`, of the first image in `names` that has one; None if there is none."""
    cameras = dict(_read(database, "SELECT name, camera_id FROM images"))
    return next((int(cameras[name]) for name in names if name in cameras), None)


def pairs(database: Path) -> set[tuple[str, str]]:
    """Return the pairs of names already matched in the `database`, each in both orders."""
    names = dict(_read(database, "SELECT image_id, name FROM images"))
    numbers = [number for (number,) in _read(database, "SELECT pair_id FROM two_view_geometries")]
    found = {(names[number // PAIR_BASE], names[number % PAIR_BASE]) for number in numbers}
    return found | {pair[::-1] for pair in found}


def connected(database: Path) -> int:
    """Return the number of pairs in the `database` with matches that fit a geometry."""
    return rows(database, "two_view_geometries", "SUM(rows > 0)")


def matches(database: Path, most: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the verified matches of connected pairs, as positions of features in both images.

    Args:
        database: the database.
        most: maximum number of pairs, spread evenly over all pairs.

    Returns:
        Two arrays (M, 2) for each pair, in units of the longer side from the image's centre, y down.
    """
    query = "SELECT pair_id, rows, data FROM two_view_geometries WHERE rows > 0 ORDER BY pair_id"
    connected = _read(database, query)
    found = []
    for number, count, content in connected[:: -(-len(connected) // most) or 1]:
        indices = np.frombuffer(content, np.uint32).reshape(count, 2)
        first, second = number // PAIR_BASE, number % PAIR_BASE
        found.append((_positions(database, first)[indices[:, 0]], _positions(database, second)[indices[:, 1]]))
    return found


def _positions(database: Path, image: int) -> np.ndarray:
    """Return the positions (K, 2) of an image's features, in units of the longer side from the image's centre."""
    query = (
        "SELECT width, height, rows, cols, data FROM keypoints "
        f"JOIN images USING (image_id) JOIN cameras USING (camera_id) WHERE image_id = {int(image)}"
    )
    [(width, height, count, columns, content)] = _read(database, query)
    positions = np.frombuffer(content, np.float32).reshape(count, columns)[:, :2].astype(np.float64)
    return (positions - np.array([width, height]) / 2) / max(width, height)


def _read(database: Path, query: str) -> list[tuple]:
    if not database.is_file():
        return []
    try:
        with closing(_opened(database)) as opened:
            return opened.execute(query).fetchall()
    except sqlite3.OperationalError:  # the table does not exist yet
        return []


def _opened(database: Path) -> sqlite3.Connection:
    return sqlite3.connect(f"file:{database.resolve().as_posix()}?mode=ro", uri=True, timeout=0.1)
