"""Photographs of the courtyard as a crowd takes them: people walk through, and light and cameras differ.

Validation and test images are clean and in daylight. The truth about each training image is written beside it, as
`r_000_truth.png`; no data format reads it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import numpy.typing as npt

from nerfloom.dataparsers.procedural.courtyard import COURTYARD, courtyard_poses
from nerfloom.dataparsers.procedural.crowd import crowds
from nerfloom.dataparsers.procedural.scene import DAYLIGHT, Light, Parts, sun_at
from nerfloom.dataparsers.procedural.views import (
    CAMERA_ANGLE,
    complete_folder,
    in_parallel,
    lay_out,
    render_view,
    visible_parts,
    write_views,
)

SHOWN, TOUCHED = 255, 128
"""Values of the truth: for pixels with a distractor at their centre, and for others that a distractor changes, by its
edge, its shadow or the light that it blocks. All others are 0; they are the same as without distractors."""
STOPS = 1.0
"""Maximum exposure of an image above or below daylight's; one stop doubles the light."""
WARMTH = 0.4
"""Maximum gain of red over green, and of green over blue, in stops."""


@dataclass(frozen=True)
class Changing:
    """Differences between training images."""

    exposure: bool = False
    """Whether the camera's exposure differs."""
    white_balance: bool = False
    """Whether the camera's white balance differs."""
    sun: bool = False
    """Whether the position of the sun differs."""


def lights(count: int, changing: Changing, seed: int) -> list[Light]:
    """Return the light of each training image: daylight, except for the changes.

    Args:
        count: number of images.
        changing: the properties that differ between them.
        seed: seed of the data set. Each property changes in the same way whether another changes or not.
    """
    found = []
    for stops, warmth, azimuth, height in np.random.default_rng([seed, 3]).uniform(-1, 1, (count, 4)):
        level = 2.0 ** (STOPS * stops * changing.exposure)
        tint = 2.0 ** (WARMTH * warmth * changing.white_balance)
        sun = (
            sun_at(math.radians(-118 + 70 * azimuth), math.radians(50 + 20 * height)) if changing.sun else DAYLIGHT.sun
        )
        found.append(Light(sun, (level * tint, level, level / tint)))
    return found


def write_photographs(
    folder: Path,
    *,
    size: int = 200,
    counts: dict[str, int] | None = None,
    distractors: float = 0.0,
    changing: Changing = Changing(),
    seed: int = 0,
) -> None:
    """Write a data set in NeRF-Synthetic's format, completely or not at all; its files are as from `write_views`.

    Args:
        folder: folder to create. If another process creates it meanwhile, its content is kept.
        size: width and height of the images, pixels.
        counts: number of images of the splits train, val and test.
        distractors: mean share of the training images' pixels that show a distractor, at most 0.4.
        changing: the properties that differ between training images.
        seed: seed of cameras, distractors and light. The same seed gives the same bytes.

    Raises:
        OSError: if the folder cannot be written.
    """
    counts = counts or {"train": 80, "val": 8, "test": 16}
    poses = {split: courtyard_poses(split, count, seed) for split, count in counts.items()}
    training = poses.pop("train")
    with complete_folder(folder) as temporary:
        places = lay_out(temporary, "train", training, moving=False)
        jobs = [
            (path, pose, people, lit)
            for (path, pose, _), people, lit in zip(
                places, crowds(training, distractors, seed), lights(len(training), changing, seed), strict=True
            )
        ]
        in_parallel(partial(_write_photograph, size=size), jobs, "Photographing the courtyard")
        write_views(temporary, poses, COURTYARD, size, "Rendering the courtyard")


def _write_photograph(path: Path, pose: npt.NDArray[np.float64], people: Parts, lit: Light, *, size: int) -> None:
    """Write an image and the truth about it."""
    clean = render_view(pose, CAMERA_ANGLE, size, size, geometry=False, parts=COURTYARD, lit=lit)[0]
    shown, truth = clean, np.zeros((size, size), dtype=np.uint8)
    if people:
        everything = {**COURTYARD, **people}
        shown = render_view(pose, CAMERA_ANGLE, size, size, geometry=False, parts=everything, lit=lit)[0]
        truth[(shown != clean).any(-1)] = TOUCHED
        truth[visible_parts(pose, (size, size), everything)[1] >= len(COURTYARD)] = SHOWN
    iio.imwrite(path, shown)
    iio.imwrite(path.with_name(f"{path.stem}_truth.png"), truth)
