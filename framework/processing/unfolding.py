"""Reconstructions that something repeated has folded (`nerfloom.scene.folds`), taken apart.

What repeats connects photographs of opposite sides. Neighbours of a sequence do show the same side, so photographs are
first placed by matches of neighbours alone. What that drifts is mended in a second reconstruction, with the matches
of photographs that look the same way in the first.
"""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerfloom.base.console import say
from nerfloom.data.image_files import read_image
from nerfloom.processing.colmap import Model
from nerfloom.processing.database import PAIR_BASE
from nerfloom.scene.folds import angle_between, folds, in_order, thumbnail

NEXT = 3
"""Number of next photographs that are neighbours of one."""
SAME_WAY = 50.0
"""Maximum angle between cameras that look the same way, degrees: less than any fold that is noticed."""
ENOUGH = 0.9
"""Minimum number of photographs placed without the fold, as a share of those placed with it."""

Reconstruct = Callable[[Path, Path], "tuple[Model | None, list[int]]"]
"""Function of a database and a folder for models that reconstructs, and returns the largest model, None without, and
the number of images of each."""


@dataclass(frozen=True)
class Unfolded:
    """A reconstruction without the fold."""

    model: Model
    """The reconstruction."""
    database: Path
    """COLMAP's database, with the matches it is made from."""
    models: Path
    """Folder of its models."""
    sizes: list[int]
    """Number of images of each of the models."""


def thumbnails_of(images: Path, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Return the thumbnail of each image by its name.

    Args:
        images: folder of the images.
        names: their names.
    """
    return {name: thumbnail(read_image(images / name)) for name in names}


def folded_pairs(model: Model, thumbnails: dict[str, np.ndarray]) -> list[tuple[str, str]]:
    """Return the names of neighbours that look alike, and whose cameras look in quite different directions.

    Args:
        model: the reconstruction.
        thumbnails: thumbnail of each image by its name.
    """
    names = list(model.images)
    ahead = np.array([_ahead(model, name) for name in names]).reshape(-1, 3)
    pairs = folds(names, ahead, np.array([thumbnails[name] for name in names]).reshape(len(names), -1))
    return [(names[i], names[j]) for i, j in pairs]


def unfold(
    model: Model, thumbnails: dict[str, np.ndarray], database: Path, work: Path, reconstruct: Reconstruct
) -> Unfolded | None:
    """Reconstruct without the matches that fold, where the model is folded.

    Args:
        model: the reconstruction from all matches.
        thumbnails: thumbnail of each image by its name.
        database: COLMAP's database with all matches, which is left as it is.
        work: folder for databases and models.
        reconstruct: makes a model from a database.

    Returns:
        The new reconstruction; None if the model is not folded, or cannot be unfolded, which is then said.
    """
    pairs = folded_pairs(model, thumbnails)
    if not pairs:
        return None
    angle = angle_between(*(_ahead(model, name) for name in pairs[0]))
    say(
        f"{pairs[0][0]} and {pairs[0][1]} look alike, but their cameras look {angle:.0f} degrees apart "
        f"(such pairs: {len(pairs)}): something that repeats has folded the reconstruction. Unfolding it"
    )
    names, best, used = sorted(thumbnails), None, 0
    names = [names[index] for index in in_order(names)]
    near = {(names[i], names[j]) for i in range(len(names)) for j in range(i + 1, min(i + 1 + NEXT, len(names)))}
    allowed = near
    for stage in ("neighbours", "unfolded"):
        matches, folder = work / f"{stage}.db", work / stage
        _copy_with(database, matches, allowed)
        made, sizes = reconstruct(matches, folder)
        if made is None or len(made.images) < ENOUGH * len(model.images) or folded_pairs(made, thumbnails):
            break
        best, used = Unfolded(made, matches, folder, sizes), len(allowed)
        allowed = near | {
            (first, second)
            for index, first in enumerate(made.images)
            for second in list(made.images)[index + 1 :]
            if angle_between(_ahead(made, first), _ahead(made, second)) <= SAME_WAY
        }
    if best is None:
        say(
            "the photographs could not be placed by their neighbours alone, so the poses stay as they are, and some of "
            f"them are wrong: take more photographs on the way from {pairs[0][0]} to {pairs[0][1]}, or leave out those "
            "that have little in common with the others"
        )
    else:
        say(f"unfolded: {len(best.model.images)} images, from {used} pairs that look the same way")
    return best


def _ahead(model: Model, name: str) -> np.ndarray:
    """Return the unit vector (3,) in which a camera looks: the third row of its world-to-camera rotation."""
    row = model.images[name][2][2, :3]
    return row / np.linalg.norm(row)


def _copy_with(database: Path, target: Path, pairs: Iterable[tuple[str, str]]) -> None:
    """Copy COLMAP's database with the matches of some pairs of names only."""
    shutil.copyfile(database, target)
    with closing(sqlite3.connect(target)) as opened, opened:
        numbers = dict(opened.execute("SELECT name, image_id FROM images"))
        kept = [
            (min(i, j) * PAIR_BASE + max(i, j),)
            for i, j in ((numbers[first], numbers[second]) for first, second in pairs)
        ]
        opened.execute("CREATE TEMP TABLE kept (pair_id INTEGER PRIMARY KEY)")
        opened.executemany("INSERT OR IGNORE INTO kept VALUES (?)", kept)
        for table in ("matches", "two_view_geometries"):
            opened.execute(f"DELETE FROM {table} WHERE pair_id NOT IN (SELECT pair_id FROM kept)")
