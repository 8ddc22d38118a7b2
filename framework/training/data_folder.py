"""The folder given by --data: detection of its format, and advice if it has none."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from nerfloom.base.console import say
from nerfloom.base.counts import counted
from nerfloom.base.errors import ConfigError, DataError
from nerfloom.data.folders import walk
from nerfloom.data.suffixes import IMAGE_SUFFIXES, VIDEO_SUFFIXES
from nerfloom.registry import load_dataparser, registered

if TYPE_CHECKING:
    from nerfloom.data.parsed_scene import DataParser

PARTS = re.compile(
    r"transforms(_train|_val|_test)?\.json|poses_bounds\.npy|(cameras|frames|images|points3D|rigs)\.(bin|txt)"
    r"|metadata\.json|meta_data\.json|cameras(_sphere)?\.npz|.+\.tsv|(image|mask)s?(_\d+)?|sparse|colmap|[0-9]"
    r"|train|val|test|rgb|EXR_RGBD|keyframes"
)
"""Names of files and folders inside a data folder that users may pass instead of the folder itself."""
MAX_LEVELS = 3
"""Maximum number of levels between such a part and the data folder."""
ARCHIVES = (".zip", ".7z", ".rar", ".tar", ".tgz", ".gz", ".xz", ".zst")
"""Suffixes of archives."""
MAX_FILES = 5000
"""Maximum number of files examined for advice."""
MAX_FOLDERS = 100
"""Maximum number of folders examined for advice."""


def find_data(path: Path | None, named: str | None = None) -> tuple[Path | None, str]:
    """Return the data folder and its format.

    A path inside a data folder, such as transforms.json or sparse/0, stands for the folder. Formats that fail to load
    are reported and ignored.

    Args:
        path: the user's path; None for the embedded scene.
        named: the format that the user named; None to detect it. A named format need not recognise the folder.

    Raises:
        DataError: if the folder does not exist, if no format recognises it, or if several do.
    """
    if path is None:
        return None, named or "procedural"
    formats = _formats([named] if named else list(registered("dataparsers")))
    for folder in _candidates(path):
        matches = [name for name, parser in formats.items() if _recognizes(name, parser, folder)]
        if len(matches) == 1:
            return folder, matches[0]
        if matches:
            several = " or ".join(matches)
            raise DataError(
                f"--data {folder}: the format may be {several}; name it after the flags, such as '{matches[0]}'"
            )
    if named is not None:
        _compare(path, named)
        return path, named
    raise DataError(f"--data {path}: {_advice(path, formats)}")


def _candidates(path: Path) -> Iterator[Path]:
    """Yield the folder, and its parents while the name belongs to a part of a data folder."""
    if os.path.isdir(path):  # `Path.is_dir` raises for invalid file names
        yield path
    elif not os.path.isfile(path):
        return
    for _ in range(MAX_LEVELS):
        if not PARTS.fullmatch(path.name):
            return
        path = path.parent
        yield path


def _formats(names: list[str]) -> dict[str, type[DataParser]]:
    """Load the formats. Broken ones are skipped with a warning, but a single format, named by the user, must load."""
    formats = {}
    for name in names:
        try:
            formats[name] = load_dataparser(name)
        except ConfigError as error:
            if len(names) == 1:
                raise
            say(f"warning: {error}; the format is ignored")
    return formats


def _recognizes(name: str, parser: type[DataParser], path: Path) -> bool:
    try:
        return parser.recognizes(path)
    except Exception as error:  # an error in one plugin must not affect other formats
        say(f"warning: data format '{name}' failed to examine {path}: {type(error).__name__}: {error}; it is ignored")
        return False


def _compare(path: Path, named: str) -> None:
    """Report the formats that recognise a folder which the format that the user named does not recognise."""
    formats = _formats(list(registered("dataparsers")))
    if others := [name for name, parser in formats.items() if _recognizes(name, parser, path)]:
        say(f"--data {path} looks like {' or '.join(others)}, not {named}; to read it as such, leave out {named}")


def _advice(path: Path, formats: Mapping[str, type[DataParser]]) -> str:
    """Return advice about a path that is not a data folder of the `formats`."""
    if not os.path.exists(path):
        return "there is no such folder"
    if os.path.isfile(path):
        if path.suffix.lower() in VIDEO_SUFFIXES:
            return f"a video has no camera poses yet. {_processing('video', path)}"
        if path.suffix.lower() in ARCHIVES:
            return "this is an archive; unpack it, and name the folder"
        if path.suffix.lower() == ".json":
            return f"this is a file, not a data folder; to read it as a transforms.json: --data {path} nerfstudio"
        return "this is a file, not a data folder"
    inside = (folder for folder, _ in islice(walk(path), 1, MAX_FOLDERS))
    if data := [folder for folder in inside if any(_recognizes(name, formats[name], folder) for name in formats)]:
        others = f"; {len(data) - 1} more folders have data" if len(data) > 1 else ""
        return f"the data is in a folder inside: --data {shlex.quote(str(data[0]))}{others}"
    files = list(islice((folder / name for folder, names in walk(path) for name in names), MAX_FILES))
    if count := sum(file.suffix.lower() in IMAGE_SUFFIXES for file in files):
        number = counted(count, "images") if len(files) < MAX_FILES else "images"
        return f"there are {number}, but no camera poses. {_processing('images', path)}"
    if videos := sorted(file for file in files if file.suffix.lower() in VIDEO_SUFFIXES):
        return f"a video has no camera poses yet. {_processing('video', videos[0])}"
    return f"the folder's format is unknown. Known: {', '.join(registered('dataparsers'))}"


def _processing(kind: str, path: Path) -> str:
    """Return the commands that create a data folder."""
    output = processed_folder(path)
    source, target = shlex.quote(str(path)), shlex.quote(str(output))
    return f"Estimate them first: ns-process-data {kind} --data {source} --output-dir {target} (then: --data {target})"


def processed_folder(path: Path) -> Path:
    """Return the default output folder for processing `path`, a folder of images or a video: beside it."""
    resolved = path if path.name not in ("", "..") else path.resolve()
    return resolved.with_name(f"{resolved.stem if resolved.is_file() else resolved.name}-processed")
