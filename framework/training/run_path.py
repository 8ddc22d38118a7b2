"""Paths of runs and their files. This module does not import torch."""

from __future__ import annotations

import errno
import os
import tempfile
from pathlib import Path

from nerfloom.base.console import say
from nerfloom.base.errors import CheckpointError, ConfigError, DataError, nearest
from nerfloom.blocks.files import NAME as BLOCKS

CONFIG = "config.yml"
"""Name of the settings in a run's folder."""
CHECKPOINTS = "nerfstudio_models"
"""Name of the checkpoints' folder in a run's folder."""
LEVELS = ("*", "*/*", "*/*/*")
"""Patterns of runs below a folder: outputs/{experiment}/{method}/{timestamp}."""


def config_file(path: Path) -> Path:
    """Return the path of a run's config.yml, or of the blocks.yml of a scene in blocks.

    For a folder of runs, choose the newest and print it. Runs with a checkpoint take precedence, since a later run may
    have ended before its first checkpoint.

    Args:
        path: the file itself, the run's folder, or a folder above it, such as ``outputs``.

    Raises:
        ConfigError: if `path` is missing, a checkpoint, or a folder without a run.
    """
    if not os.path.lexists(path):
        raise ConfigError(f"cannot read {path}: {os.strerror(errno.ENOENT)}{_nearest_to(path)}")
    if path.suffix == ".ckpt":
        run = path.absolute().parent.parent
        raise ConfigError(f"{path} is a checkpoint; name its run, such as {run}, and the file by --load-checkpoint")
    if not os.path.isdir(path):
        return path
    for name in (CONFIG, BLOCKS):
        if (path / name).is_file():
            return path / name
    runs = sorted((file for level in LEVELS for file in path.glob(f"{level}/{CONFIG}")), key=os.path.getmtime)
    if not runs:
        raise ConfigError(f"{path} is not a run's folder: it has no {CONFIG}, and there is no run below it")
    newest = next((file for file in reversed(runs) if has_checkpoint(file.parent)), runs[-1])
    later = len(runs) - 1 - runs.index(newest)
    without = f"; {later} later {'have' if later > 1 else 'has'} no checkpoint" if later else ""
    say(f"the newest of {len(runs)} runs in {path}: {newest.parent}{without}")
    return newest


def has_checkpoint(folder: Path) -> bool:
    """Return whether the run in `folder` has a checkpoint, readable or not."""
    return any((folder / CHECKPOINTS).glob("step-*.ckpt"))


def trained_run(path: Path, checkpoint: Path | None = None, data: Path | None = None) -> Path:
    """Return the config.yml of a trained run, a file of Gaussians or an octree, after checking that all paths exist.

    Args:
        path: as for `config_file`, or a file of Gaussians.
        checkpoint: the requested checkpoint; None for any.
        data: the requested data folder, if any.

    Raises:
        ConfigError: if there is no such run or file.
        CheckpointError: if the checkpoint is missing, or the run has none.
        DataError: if there is no such data.
    """
    found = config_file(path)
    if checkpoint is not None and not os.path.isfile(checkpoint):
        raise CheckpointError(f"there is no checkpoint {checkpoint}{_nearest_to(checkpoint)}")
    if checkpoint is None and found.name == CONFIG and not has_checkpoint(found.parent):
        raise CheckpointError(f"{found.parent / CHECKPOINTS} holds no checkpoint")
    if data is not None:
        check_data(data)
    return found


def data_name(data: Path | None) -> str:
    """Return the name of the folder `data` in names of folders and files; procedural for the embedded scene, None."""
    return "procedural" if data is None else data.resolve().name


def check_data(data: Path) -> None:
    """Check that the folder `data`, or a part of one, exists.

    Raises:
        DataError: if it does not exist; the message suggests the nearest name in the same folder.
    """
    if not os.path.lexists(data):
        raise DataError(f"--data {data}: there is no such folder{_nearest_to(data)}")


def check_writable(folder: Path, what: str) -> None:
    """Check that `folder`, new or existing, can be written to; `what` is for the message. Leaves nothing there.

    Raises:
        ConfigError: if nothing can be written there.
    """
    above = next((place for place in (folder, *folder.absolute().parents) if os.path.lexists(place)), folder)
    try:
        if not os.path.isdir(above):
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
        tempfile.TemporaryFile(dir=above).close()
    except OSError as error:
        raise ConfigError(f"cannot write {what} {folder}: {error.strerror or error}; name another place") from error


def _nearest_to(path: Path) -> str:
    """Return the end of a message that suggests an existing name for a missing path."""
    missing, above = path, path.absolute().parent
    while not above.is_dir() and above != above.parent:
        missing, above = above, above.parent
    try:
        names = sorted(entry.name for entry in os.scandir(above) if not entry.name.startswith("."))
    except OSError:
        return ""
    hint = nearest(missing.name, names)
    return f". {hint} (in {above})" if hint.startswith("Did") else ""
