"""Repair of reconstructions folded by a repeated pattern (`nerfloom.scene.folded_poses`).

A repeated pattern connects photographs of opposite sides. Neighbours in a sequence do show the same side, so
photographs are first placed by matches between neighbours only. A second reconstruction corrects the drift, with
matches between photographs that look the same way in the first one.
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
from nerfloom.scene.folded_poses import angle_between, folded_neighbours, in_order, thumbnail

NEIGHBOURS = 3
"""Number of following photographs that count as neighbours."""
MAX_ANGLE_ALIKE = 50.0
"""Maximum angle between cameras that look the same way, degrees; less than any detected fold."""
MIN_PLACED_SHARE = 0.9
"""Minimum number of photographs placed without the fold, relative to the number with it."""

Reconstruct = Callable[[Path, Path], "tuple[Model | None, list[int]]"]
"""Function of a database and a folder for models. It reconstructs, and returns the largest model (None without) and the
number of images in each model."""


@dataclass(frozen=True)
class Unfolded:
    """A reconstruction without the fold."""

    model: Model
    """The reconstruction."""
    database: Path
    """COLMAP's database with the matches used."""
    models: Path
    """Folder of its models."""
    sizes: list[int]
    """Number of images in each model."""


def thumbnails_of(images: Path, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Return the thumbnail of each image in the folder `images`, by its name in `names`."""
    return {name: thumbnail(read_image(images / name)) for name in names}


def folded_pairs(model: Model, thumbnails: dict[str, np.ndarray]) -> list[tuple[str, str]]:
    """Return neighbours of `model` that look alike by `thumbnails`, though their cameras look far apart, by name."""
    names = list(model.images)
    ahead = np.array([_ahead(model, name) for name in names]).reshape(-1, 3)
    pairs = folded_neighbours(names, ahead, np.array([thumbnails[name] for name in names]).reshape(len(names), -1))
    return [(names[i], names[j]) for i, j in pairs]


def unfold(
    model: Model, thumbnails: dict[str, np.ndarray], database: Path, work: Path, reconstruct: Reconstruct
) -> Unfolded | None:
    """Reconstruct without the matches that fold the model, if it is folded.

    Args:
        model: the reconstruction from all matches.
        thumbnails: thumbnail of each image, by name.
        database: COLMAP's database with all matches; it is not changed.
        work: folder for databases and models.
        reconstruct: function that makes models from a database.

    Returns:
        The new reconstruction; None if the model is not folded, or cannot be unfolded, which is reported.
    """
    pairs = folded_pairs(model, thumbnails)
    if not pairs:
        return None
    angle = angle_between(*(_ahead(model, name) for name in pairs[0]))
    say(
        f"{pairs[0][0]} and {pairs[0][1]} look alike, but their cameras look {angle:.0f} degrees apart "
        f"({len(pairs)} such pairs): a repeated pattern has folded the reconstruction. Unfolding it"
    )
    names, best, used = sorted(thumbnails), None, 0
    names = [names[index] for index in in_order(names)]
    near = {(names[i], names[j]) for i in range(len(names)) for j in range(i + 1, min(i + 1 + NEIGHBOURS, len(names)))}
    allowed = near
    for stage in ("neighbours", "unfolded"):
        matches, folder = work / f"{stage}.db", work / stage
        _copy_with(database, matches, allowed)
        made, sizes = reconstruct(matches, folder)
        if made is None or len(made.images) < MIN_PLACED_SHARE * len(model.images) or folded_pairs(made, thumbnails):
            break
        best, used = Unfolded(made, matches, folder, sizes), len(allowed)
        allowed = near | {
            (first, second)
            for index, first in enumerate(made.images)
            for second in list(made.images)[index + 1 :]
            if angle_between(_ahead(made, first), _ahead(made, second)) <= MAX_ANGLE_ALIKE
        }
    if best is None:
        say(
            "the photographs could not be placed by their neighbours alone, so the poses stay as they are, and some of "
            f"them are wrong: take more photographs on the way from {pairs[0][0]} to {pairs[0][1]}, or leave out "
            "photographs that share little with the others"
        )
    else:
        say(f"unfolded: {len(best.model.images)} images, from {used} pairs that look the same way")
    return best


def _ahead(model: Model, name: str) -> np.ndarray:
    """Return the unit viewing direction (3,) of a camera: the third row of its world-to-camera rotation."""
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
