"""The files of a run that was stopped, and the check whether another can go on with them."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

from nerfloom.base.console import say
from nerfloom.base.errors import DataError
from nerfloom.processing.settings import ColmapFlags
from nerfloom.processing.video import write_frames

STARTED = "started.json"
"""File that says what a run was started with."""
FRAMES = "frames"
"""Folder of a video's frames."""
FREE = (
    "output_dir", "overwrite", "resume", "num_downscales", "matching_method", "exhaustive_limit", "num_neighbors",
    "sequential_overlap", "refine_intrinsics", "device_type", "num_threads", "verbose",
)  # fmt: skip
"""Flags that may differ from those of the run that was stopped: features and matches do not depend on them."""


def unfinished(output: Path) -> Path:
    """Return the folder of what is unfinished in the folder `output` that is written."""
    return output / "colmap" / "unfinished"


def mark(flags: ColmapFlags, sources: list[Path]) -> None:
    """Write what a run is started with.

    Args:
        flags: the user's flags.
        sources: the files that it reads, under `flags.data`; of a video, that file alone.
    """
    work = unfinished(flags.output_dir)
    work.mkdir(parents=True, exist_ok=True)
    (work / STARTED).write_text(json.dumps(_state(flags, sources)), encoding="utf-8")


def go_on(flags: ColmapFlags, sources: list[Path]) -> None:
    """Check that features and matches of the run that was stopped serve this one, and remove what else it has left.

    Args:
        flags: the user's flags.
        sources: the files that are read, as in `mark`.

    Raises:
        DataError: if that run had other flags or other files.
    """
    work = unfinished(flags.output_dir)
    try:
        before: dict[str, Any] = json.loads((work / STARTED).read_text(encoding="utf-8"))
        flags_before, files_before = dict(before["flags"]), dict(before["files"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"--resume: {work} does not say what it was started with; --overwrite begins again") from error
    now = _state(flags, sources)
    for name, value in now["flags"].items():
        if flags_before.get(name) != value:
            flag = "--" + name.replace("_", "-")
            raise DataError(
                f"--resume: {flag} is {value}, and was {flags_before.get(name)}; give the same flags, "
                "or begin again by --overwrite"
            )
    files = now["files"]
    other = sorted(name for name in files.keys() | files_before if files.get(name) != files_before.get(name))
    if other:
        raise DataError(
            f"--resume: {len(other)} files of --data {flags.data} were added, removed or changed since, "
            f"the first: {other[0]}; begin again by --overwrite"
        )
    for path in work.iterdir():
        if path.name not in (STARTED, FRAMES) and not path.name.startswith("database.db"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    say(f"resuming: features and matches in {work} are kept")


def frames_of(output: Path, video: Path, target: int) -> tuple[Path, list[Path]]:
    """Return the folder of a video's frames, and their paths in it; they are written unless they are there already.

    Args:
        output: the folder that is written.
        video: the video file.
        target: number of frames to write.

    Raises:
        DataError: as `write_frames`.
    """
    folder = unfinished(output) / FRAMES
    if folder.is_dir():
        return folder, sorted(path.relative_to(folder) for path in folder.iterdir())
    partial = folder.with_name("some_frames")
    names = write_frames(video, partial, target)
    partial.rename(folder)
    return folder, names


def _state(flags: ColmapFlags, sources: list[Path]) -> dict[str, Any]:
    kept = {name: value for name, value in asdict(flags).items() if name not in FREE}
    root = flags.data if flags.data.is_dir() else flags.data.parent
    stats = {source.as_posix(): (root / source).stat() for source in sources}
    return {
        "flags": {name: str(value.resolve()) if isinstance(value, Path) else value for name, value in kept.items()},
        "files": {name: [stat.st_size, stat.st_mtime_ns] for name, stat in stats.items()},
    }
