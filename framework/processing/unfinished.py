"""Files of a stopped run, and the check whether another run can continue it."""

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
"""File that records a run's input."""
FRAMES = "frames"
"""Folder of a video's frames."""
VIEWS = "views"
"""Folder of the views of panoramas."""
FREE = (
    "output_dir", "overwrite", "resume", "num_downscales", "matching_method", "exhaustive_limit", "num_neighbors",
    "sequential_overlap", "refine_intrinsics", "mask_moving", "mask_seconds", "device_type", "num_threads", "verbose",
)  # fmt: skip
"""Flags that may differ from the stopped run's, because features and matches do not depend on them."""


def unfinished(output: Path) -> Path:
    """Return the folder of unfinished files in the output folder `output`."""
    return output / "colmap" / "unfinished"


def mark(flags: ColmapFlags, sources: list[Path]) -> None:
    """Record a run's input: its `flags`, and the `sources` to read below `flags.data`; of a video, that file alone."""
    work = unfinished(flags.output_dir)
    work.mkdir(parents=True, exist_ok=True)
    (work / STARTED).write_text(json.dumps(_state(flags, sources)), encoding="utf-8")


def go_on(flags: ColmapFlags, sources: list[Path]) -> None:
    """Check that this run can use a stopped run's features and matches, by `flags` and `sources`, and remove the rest.

    Raises:
        DataError: if that run had other flags or other files.
    """
    work = unfinished(flags.output_dir)
    try:
        before: dict[str, Any] = json.loads((work / STARTED).read_text(encoding="utf-8"))
        flags_before, files_before = dict(before["flags"]), dict(before["files"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"--resume: {work} has no record of its input; use --overwrite to start again") from error
    now = _state(flags, sources)
    for name, value in now["flags"].items():
        if flags_before.get(name) != value:
            flag = "--" + name.replace("_", "-")
            raise DataError(
                f"--resume: {flag} is {value}, but was {flags_before.get(name)}; use the same flags, "
                "or start again with --overwrite"
            )
    files = now["files"]
    other = sorted(name for name in files.keys() | files_before if files.get(name) != files_before.get(name))
    if other:
        raise DataError(
            f"--resume: {len(other)} files of --data {flags.data} were added, removed or changed since, "
            f"the first: {other[0]}; start again with --overwrite"
        )
    for path in work.iterdir():
        if path.name not in (STARTED, FRAMES, VIEWS) and not path.name.startswith("database.db"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    say(f"resuming: using features and matches in {work}")


def frames_of(output: Path, video: Path, target: int) -> tuple[Path, list[Path]]:
    """Return the folder of `target` frames of a `video` and their paths in it; write them in `output` once.

    Raises:
        DataError: see `write_frames`.
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
