"""Image files of the cameras of another program, by their names."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from nerfloom.base.console import say
from nerfloom.base.errors import DataError
from nerfloom.data.names_on_disk import files_below, match_names, nearest_on_disk, without_ending
from nerfloom.processing.capture import Capture, PosedCamera

MAX_PART, MAX_PATH = 250, 3000
"""Maximum length of a part of a name, and of a whole name, bytes; systems refuse to look for longer ones."""


class PlacedImages(NamedTuple):
    """The image files of a capture's cameras."""

    cameras: dict[Path, PosedCamera]
    """Cameras by the path of their image in the folder of the photographs, in the order of the cameras."""
    left_out: Counter[str]
    """Number of the capture's cameras without image by the reason."""


def placed_images(folder: Path, capture: Capture) -> PlacedImages:
    """Find the image files of a capture's cameras.

    A name is matched as in all data sets (`names_on_disk`), and at last by its part after the last slash, without
    ending, where one camera and one file have it. Other images in their folders, which no camera has, are counted and
    reported, because some programs list only the cameras that they placed.

    Args:
        folder: folder of the photographs.

    Raises:
        DataError: if no camera has an image, or the capture has no camera.
    """
    if not capture.cameras:
        raise DataError(f"{capture.program} placed none of {capture.total} cameras: {reasons(capture.left_out)}")
    twice = Counter(camera.name for camera in capture.cameras)
    cameras = [camera for camera in capture.cameras if twice[camera.name] == 1 and _is_possible(camera.name)]
    matches = match_names(folder, [camera.name for camera in cameras])
    for note in matches.notes:
        say(f"{folder}: images: {note}")
    files = {name: file for name, file in matches.files.items() if (folder / file).is_file()}
    missing = [camera.name for camera in cameras if camera.name not in files]
    taken = set(files.values())
    by_part = _paired(missing, [file for file in files_below(folder) if file not in taken] if missing else [])
    files |= {name: file for name, file in by_part.items() if (folder / file).is_file()}
    placed = {Path(files[camera.name]): camera for camera in cameras if camera.name in files}
    shared = sum(count for count in twice.values() if count > 1)
    if not placed:
        name = capture.cameras[0].name
        raise DataError(
            f"--data {folder} has the image of none of {len(capture.cameras)} cameras, such as {name!r}: "
            f"{nearest_on_disk(folder / Path(name).name) if _is_possible(name) else 'it has no such name'}"
        )
    _report_others(folder, placed)
    left_out = {"with the name of another camera": shared, "without image": len(capture.cameras) - shared - len(placed)}
    return PlacedImages(placed, Counter(left_out))


def images_as_named(capture: Capture) -> PlacedImages:
    """Return the images of a capture with paths of images as the names of its cameras.

    Raises:
        DataError: if it has no camera.
    """
    if not capture.cameras:
        raise DataError(f"{capture.program} placed none of {capture.total} cameras: {reasons(capture.left_out)}")
    return PlacedImages({Path(camera.name): camera for camera in capture.cameras}, Counter())


def reasons(left_out: Counter[str]) -> str:
    """Return the numbers in `left_out` with their reasons, as the end of a message."""
    return ", ".join(f"{count} {reason}" for reason, count in left_out.items() if count) or "there are none"


def _report_others(folder: Path, placed: Iterable[Path]) -> None:
    """Report the number of images in the folders of the `placed` images that are not among them."""
    ours = {path.as_posix() for path in placed}
    folders = {name.rpartition("/")[0] for name in ours}
    others = [name for name in files_below(folder) if name not in ours and name.rpartition("/")[0] in folders]
    others = [name for name in others if (folder / name).is_file()]  # not the full size of a reduced image
    if others:
        say(f"{folder}: {len(others)} other images have no placed camera, the first: {others[0]}")


def _is_possible(name: str) -> bool:
    """Return whether the system can look for a file of this name."""
    encoded = name.encode("utf-8", "replace")
    longest = max(len(part) for part in encoded.split(b"/"))
    return bool(name) and "\0" not in name and longest <= MAX_PART and len(encoded) <= MAX_PATH


def _paired(names: Iterable[str], files: Iterable[str]) -> dict[str, str]:
    """Return name -> file where one name and one file have the same last part without ending."""
    ours, theirs = list(names), list(files)
    known, there = Counter(map(_last_part, ours)), Counter(map(_last_part, theirs))
    by_part = {_last_part(file): file for file in theirs}
    return {name: by_part[part] for name in ours if known[part := _last_part(name)] == there[part] == 1}


def _last_part(name: str) -> str:
    return without_ending(name).rpartition("/")[2]
