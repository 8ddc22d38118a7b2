"""The output folder: never overwritten without a flag, and incomplete until transforms.json is written."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

from nerfloom.base.errors import DataError
from nerfloom.processing.settings import ColmapFlags
from nerfloom.processing.unfinished import STARTED, go_on, mark, unfinished
from nerfloom.training.data_folder import processed_folder

FINISHED = "transforms.json"
"""File written last; a folder with it is complete."""
_OURS = re.compile(r"transforms\.json|sparse_pc\.ply|colmap|unpacked|(images|masks)(_\d+)?")


def check_apart(output: Path, data: Path) -> None:
    """Check that the folder `output` to write and the input `data` do not overlap.

    Raises:
        DataError: if the output would overwrite the input or be inside it.
    """
    if output.exists() and output.resolve() == data.resolve():
        raise DataError(f"--output-dir {output} is the same folder as --data; {_advice(output)}")
    inside = data.resolve()
    if inside.is_relative_to(output.resolve()) and _OURS.fullmatch(inside.relative_to(output.resolve()).parts[0]):
        raise DataError(f"--data {data} overlaps the files written to --output-dir {output}; {_advice(output)}")


def _advice(output: Path) -> str:
    return f"choose another folder, such as: --output-dir {processed_folder(output)}"


def claim(output: Path, data: Path, overwrite: bool) -> None:
    """Create the folder `output` or, with `overwrite`, remove an earlier run's output from it, but no input `data`.

    Raises:
        DataError: if the folder is not empty and `overwrite` is False, or if files to be removed contain `data`.
    """
    if output.exists() and not output.is_dir():
        raise DataError(f"--output-dir {output} is a file; choose a folder")
    present = sorted(output.iterdir()) if output.is_dir() else []
    if is_unfinished(output) and not overwrite:
        raise DataError(f"--output-dir {output} has a stopped run; --resume continues it, --overwrite starts again")
    if present and not overwrite:
        content = "a processed data set" if (output / FINISHED).exists() else f"'{present[0].name}' but no {FINISHED}"
        raise DataError(f"--output-dir {output} has {content}; choose a new folder or use --overwrite")
    written = [path for path in present if _OURS.fullmatch(path.name)]
    for path in written:
        if data.resolve().is_relative_to(path.resolve()):
            raise DataError(f"--overwrite would remove {path}, which contains --data; choose another --output-dir")
    for path in sorted(written, key=lambda path: path.name != FINISHED):  # the mark of completion first
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()
    output.mkdir(parents=True, exist_ok=True)


def begin(flags: ColmapFlags, sources: list[Path]) -> None:
    """Claim the output folder and record the run's `sources`; with `flags.resume`, continue a stopped run.

    Raises:
        DataError: see `claim` and `unfinished.go_on`.
    """
    if flags.resume and is_unfinished(flags.output_dir):
        go_on(flags, sources)
        return
    claim(flags.output_dir, flags.data, flags.overwrite)
    mark(flags, sources)


def is_unfinished(output: Path) -> bool:
    """Return whether the folder `output` has a stopped COLMAP run."""
    return not (output / FINISHED).exists() and (unfinished(output) / STARTED).is_file()


def lacks_masks(flags: ColmapFlags) -> bool:
    """Return whether a finished run has no masks although `flags` ask for masks of moving things."""
    return flags.mask_moving and b'"mask_path"' not in (flags.output_dir / FINISHED).read_bytes()


def ready(output: Path) -> str:
    """Return the last line of a command: the data folder `output` and the command to train on it."""
    words = ("ns-train", "gaussian-splatting", "--data", str(output), "--max-seconds", "300")
    return f"data folder: {output}; next: {shlex.join(words)}"
