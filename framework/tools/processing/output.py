"""The folder that is written: refused where something would be lost, and unfinished until transforms.json is there."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

from framework.base.errors import DataError
from framework.data.data_folder import processed_folder

FINISHED = "transforms.json"
"""Written last: a folder with it is complete."""
_OURS = re.compile(r"transforms\.json|sparse_pc\.ply|colmap|(images|masks)(_\d+)?")


def check_apart(output: Path, data: Path) -> None:
    """Raises: DataError where the output would be written over the input, or among it."""
    if output.exists() and output.resolve() == data.resolve():
        raise DataError(f"--output-dir {output} is the folder that --data names; {_another(output)}")
    inside = data.resolve()
    if inside.is_relative_to(output.resolve()) and _OURS.fullmatch(inside.relative_to(output.resolve()).parts[0]):
        raise DataError(f"--data {data} overlaps what is written into --output-dir {output}; {_another(output)}")


def _another(output: Path) -> str:
    return f"name a folder of its own, as in: --output-dir {processed_folder(output)}"


def claim(output: Path, data: Path, overwrite: bool) -> None:
    """Make `output` ready to be written into: make it, or with `overwrite` remove what an earlier run wrote.

    Raises: DataError where it holds anything and `overwrite` is not given, or where that would remove `data`.
    """
    if output.exists() and not output.is_dir():
        raise DataError(f"--output-dir {output} is a file; name a folder")
    present = sorted(output.iterdir()) if output.is_dir() else []
    if present and not overwrite:
        what = "a processed data set" if (output / FINISHED).exists() else f"'{present[0].name}' but no {FINISHED}"
        raise DataError(f"--output-dir {output} holds {what}; name a new folder, or give --overwrite")
    doomed = [path for path in present if _OURS.fullmatch(path.name)]
    for path in doomed:
        if data.resolve().is_relative_to(path.resolve()):
            raise DataError(f"--overwrite would remove {path}, where --data is; name another --output-dir")
    for path in sorted(doomed, key=lambda path: path.name != FINISHED):  # first of all it is no longer finished
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()
    output.mkdir(parents=True, exist_ok=True)
