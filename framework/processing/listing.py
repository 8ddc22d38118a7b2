"""Files of a folder: images in natural order, and a report on the others."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

from nerfloom.base.console import say
from nerfloom.base.counts import counted
from nerfloom.base.errors import DataError
from nerfloom.base.evenly_spaced import evenly_spread
from nerfloom.data.folders import walk
from nerfloom.data.names_on_disk import accompanies
from nerfloom.data.suffixes import IMAGE_SUFFIXES, VIDEO_SUFFIXES

T = TypeVar("T")
READABLE = (*IMAGE_SUFFIXES, ".tga", ".ppm", ".pgm")
"""Suffixes of image files that Pillow reads (HEIC with the package pillow-heif)."""


def find_images(folder: Path, leave_out: Iterable[Path] = ()) -> list[Path]:
    """Return the image files in a folder and its subfolders, relative to it, in natural order: 'img2' before 'img10'.

    Hidden files are ignored. The number and kinds of other files are reported.

    Args:
        folder: the folder.
        leave_out: folders inside it to ignore.

    Raises:
        DataError: if there is no such folder, or it has no images.
    """
    if folder.is_file():
        raise DataError(f"--data {folder} is a file; name the folder of the images")
    if not folder.is_dir():
        raise DataError(f"--data {folder}: there is no such folder")
    images, others = _split(folder, leave_out)
    images, companions = _without_companions(images)
    if companions:
        where = companions[0].parent.as_posix()
        say(
            f"left out: {counted(len(companions), 'images')} in folders such as {where}, whose names say masks or the "
            "like"
        )
    if not images:
        raise DataError(f"--data {folder} has no images (looked for {', '.join(READABLE)}){_listed(others)}")
    if others:
        files = "1 file that is not an image" if len(others) == 1 else f"{len(others)} files that are not images"
        say(f"left out: {files}{_listed(others)}")
    return images


def evenly_spaced(items: list[T], most: int) -> list[T]:
    """Return at most `most` evenly spaced `items`, including the first and the last; report if there are more."""
    if len(items) <= most:
        return items
    say(f"{most} of {len(items)} images are taken, evenly spaced (--max-dataset-size)")
    return [items[index] for index in evenly_spread(len(items), most)]


def kind_of(kind: str, data: Path) -> tuple[str, Path]:
    """Detect whether a path has images or a video, if the user named the wrong one of them; this is reported.

    Args:
        kind: kind of input as the user named it; returned if it fits, if neither fits, or for other kinds.
        data: the path.

    Returns:
        The kind, and the path of the folder or of the video, which may be the only video of a folder without images.

    Raises:
        DataError: if a folder without images has several videos.
    """
    if kind not in ("images", "video"):
        return kind, data
    if data.is_file():
        if kind == "images" and data.suffix.lower() in VIDEO_SUFFIXES:
            say(f"{data} is a video: using its frames, as in ns-process-data video")
            return "video", data
        return kind, data
    if not data.is_dir():
        return kind, data
    images, others = _split(data, ())
    videos = [data / path for path in others if path.suffix.lower() in VIDEO_SUFFIXES]
    if images and kind == "video":
        say(f"{data} is a folder of {counted(len(images), 'images')}: using them, as in ns-process-data images")
        return "images", data
    if not images and len(videos) > 1:
        raise DataError(f"--data {data} has {len(videos)} videos and no images; choose one: --data {videos[0]}")
    if not images and videos:
        say(f"{data} has a video and no images: using the frames of {videos[0].name}")
        return "video", videos[0]
    return kind, data


def natural_order(path: Path) -> list[tuple[int, int, str]]:
    """Return a sorting key of `path` that compares numbers in names by value."""
    parts = re.split(r"(\d+)", path.as_posix().lower())
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts if part]


def _split(folder: Path, leave_out: Iterable[Path]) -> tuple[list[Path], list[Path]]:
    """Return the images and the other files of a folder, relative to it, in natural order."""
    ignored = [path.resolve() for path in leave_out if not folder.resolve().is_relative_to(path.resolve())]
    images: list[Path] = []
    others: list[Path] = []
    for path in (place / name for place, names in walk(folder) for name in names):
        # A link to a missing file is listed, so that it is reported.
        if not path.is_file() and not path.is_symlink():
            continue
        if not any(path.resolve().is_relative_to(entry) for entry in ignored):
            (images if path.suffix.lower() in READABLE else others).append(path.relative_to(folder))
    return sorted(images, key=natural_order), sorted(others, key=natural_order)


def _without_companions(images: list[Path]) -> tuple[list[Path], list[Path]]:
    """Return the photographs, and the images that accompany them, by the names of their folders.

    If all are in such folders, all are photographs.
    """
    photographs: list[Path] = []
    companions: list[Path] = []
    for path in images:
        (companions if accompanies(path.parts[:-1]) else photographs).append(path)
    return (photographs, companions) if photographs else (images, [])


def _listed(paths: list[Path]) -> str:
    """Return the number of files of each suffix, and the first file, as the end of a message."""
    if not paths:
        return ""
    counts = Counter(path.suffix.lower() or "without suffix" for path in paths)
    kinds = ", ".join(f"{count} {suffix}" for suffix, count in counts.most_common(5))
    return f": {kinds}{', ...' if len(counts) > 5 else ''}; the first: {paths[0].as_posix()}"
