"""The folder that --data names: the format it is in, and what to do where it is in none."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from framework.base.console import say
from framework.base.errors import ConfigError, DataError
from framework.base.registry import load_dataparser, registered

if TYPE_CHECKING:
    from framework.data.dataset import DataParser

PARTS = re.compile(
    r"transforms(_train|_val|_test)?\.json|poses_bounds\.npy|(cameras|frames|images|points3D|rigs)\.(bin|txt)"
    r"|metadata\.json|.+\.tsv|(images|masks)(_\d+)?|sparse|colmap|[0-9]|train|val|test|rgb|EXR_RGBD|keyframes"
)
"""Names in a data folder that people take for the folder itself."""
HEIGHT = 3
"""Folders between such a part and its data folder, at most."""
PHOTOGRAPHS = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".heic", ".heif")
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
LOOKED_AT = 5000
"""Files that are looked at for an advice."""


def find_data(path: Path | None, named: str | None = None) -> tuple[Path | None, str]:
    """The data folder that is meant, and its format; None and the embedded scene for None.

    What lies in a data folder, such as transforms.json or sparse/0, stands for the folder. Formats that cannot be
    loaded are reported and left out.

    Args:
        named: the format, where the user named one; then it need not be recognised.
    Raises: DataError where the folder is missing, or none or several formats recognise it.
    """
    if path is None:
        return None, named or "procedural"
    formats = _formats([named] if named else list(registered("dataparsers")))
    for folder in _meant(path):
        matches = [name for name, parser in formats.items() if _recognizes(name, parser, folder)]
        if len(matches) == 1:
            return folder, matches[0]
        if matches:
            several = " or ".join(matches)
            raise DataError(f"--data {folder}: could be {several}; name one after the flags, as in '{matches[0]}'")
    if named is not None:
        return path, named
    raise DataError(f"--data {path}: {_advice(path)}")


def _meant(path: Path) -> Iterator[Path]:
    """The folder itself, and those around it as long as it is called like a part of a data folder."""
    if os.path.isdir(path):  # `Path.is_dir` raises for names that no file can have
        yield path
    elif not os.path.isfile(path):
        return
    for _ in range(HEIGHT):
        if not PARTS.fullmatch(path.name):
            return
        path = path.parent
        yield path


def _formats(names: list[str]) -> dict[str, type[DataParser]]:
    """Those of the formats that can be loaded; one that was named by the user must be."""
    found = {}
    for name in names:
        try:
            found[name] = load_dataparser(name)
        except ConfigError as error:
            if len(names) == 1:
                raise
            say(f"warning: {error}; it is left out")
    return found


def _recognizes(name: str, parser: type[DataParser], path: Path) -> bool:
    try:
        return parser.recognizes(path)
    except Exception as error:  # it should not raise, but another's mistake must not stop everyone
        say(f"warning: data format '{name}' failed to look at {path}: {type(error).__name__}: {error}; it is left out")
        return False


def _advice(path: Path) -> str:
    """Say what to do about a path that is no data folder."""
    if not os.path.exists(path):
        return "there is no such folder"
    if os.path.isfile(path):
        if path.suffix.lower() in VIDEOS:
            return f"a video has no camera poses yet. {_processing('video', path)}"
        if path.suffix.lower() == ".json":
            return f"this is a file, not a data folder; to read it as a transforms.json: --data {path} nerfstudio"
        return "this is a file, not a data folder"
    files = [Path(folder, name) for folder, name in islice(_files(path), LOOKED_AT)]
    if count := sum(file.suffix.lower() in PHOTOGRAPHS for file in files):
        what = f"{count} photograph{'s' if count > 1 else ''}" if len(files) < LOOKED_AT else "photographs"
        return f"there are {what}, but no camera poses. {_processing('images', path)}"
    if videos := sorted(file for file in files if file.suffix.lower() in VIDEOS):
        return f"a video has no camera poses yet. {_processing('video', videos[0])}"
    return f"no known data format is found there. Known: {', '.join(registered('dataparsers'))}"


def _files(path: Path) -> Iterator[tuple[str, str]]:
    """Folder and name of every file below a folder that is not hidden."""
    for folder, below, names in os.walk(path):
        below[:] = sorted(name for name in below if not name.startswith("."))
        yield from ((folder, name) for name in names if not name.startswith("."))


def _processing(kind: str, path: Path) -> str:
    """The commands that make a data folder."""
    output = processed_folder(path)
    given, written = shlex.quote(str(path)), shlex.quote(str(output))
    return f"Find them first: ns-process-data {kind} --data {given} --output-dir {written} (then: --data {written})"


def processed_folder(path: Path) -> Path:
    """A folder beside a folder of photographs, or a video, for what is made of it."""
    named = path if path.name not in ("", "..") else path.resolve()
    return named.with_name(f"{named.stem if named.is_file() else named.name}-processed")
