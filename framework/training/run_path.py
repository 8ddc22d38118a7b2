"""Paths of runs and of their files, found without torch."""

from __future__ import annotations

import errno
import os
import tempfile
from pathlib import Path

from nerfloom.base.console import say
from nerfloom.base.errors import CheckpointError, ConfigError, DataError, nearest

CONFIG = "config.yml"
"""Name of the settings in a run's folder."""
CHECKPOINTS = "nerfstudio_models"
"""Name of the checkpoints' folder in a run's folder."""
LEVELS = ("*", "*/*", "*/*/*")
"""Where runs lie below a folder: outputs/{experiment}/{method}/{timestamp}."""


def config_file(path: Path) -> Path:
    """Return the path of a run's config.yml; of a folder of runs, that of the newest, which is said.

    The newest with a checkpoint is taken if any has one: a later one may have ended before it learnt anything.

    Args:
        path: the file itself, the run's folder, or a folder above it, such as ``outputs``.

    Raises:
        ConfigError: if `path` is missing, or a folder without a run.
    """
    if not os.path.lexists(path):
        raise ConfigError(f"cannot read {path}: {os.strerror(errno.ENOENT)}{_nearest_to(path)}")
    if not os.path.isdir(path):
        return path
    if (path / CONFIG).is_file():
        return path / CONFIG
    runs = sorted((file for level in LEVELS for file in path.glob(f"{level}/{CONFIG}")), key=os.path.getmtime)
    if not runs:
        raise ConfigError(f"{path} is not a run's folder, for it has no {CONFIG}, and there is no run below it")
    newest = next((file for file in reversed(runs) if has_checkpoint(file.parent)), runs[-1])
    later = len(runs) - 1 - runs.index(newest)
    without = f"; {later} later {'have' if later > 1 else 'has'} no checkpoint" if later else ""
    say(f"the newest of {len(runs)} runs in {path}: {newest.parent}{without}")
    return newest


def has_checkpoint(folder: Path) -> bool:
    """Return whether the run in `folder` has a checkpoint, readable or not."""
    return any((folder / CHECKPOINTS).glob("step-*.ckpt"))


def trained_run(path: Path, checkpoint: Path | None = None, data: Path | None = None) -> Path:
    """Return the config.yml of a trained run, or a file of Gaussians, after a look at what is asked for.

    Args:
        path: as for `config_file`, or a file of Gaussians.
        checkpoint: the checkpoint that is asked for; any if None.
        data: the folder of the data that is asked for, if any.

    Raises:
        ConfigError: if there is no such run or file.
        CheckpointError: if there is no such checkpoint, or none.
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


def check_data(data: Path) -> None:
    """Refuse a folder of data, or a part of one, that is not there.

    Args:
        data: path of the folder or of its part.

    Raises:
        DataError: with the nearest name beside it.
    """
    if not os.path.lexists(data):
        raise DataError(f"--data {data}: there is no such folder{_nearest_to(data)}")


def check_writable(folder: Path, what: str) -> None:
    """Refuse a folder that cannot be written to, whether it exists or is to be created; nothing is left there.

    Args:
        folder: the folder.
        what: what is to be written, for the message.

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
    """Return what there is in place of a missing path, as the end of a message."""
    missing, above = path, path.absolute().parent
    while not above.is_dir() and above != above.parent:
        missing, above = above, above.parent
    try:
        names = sorted(entry.name for entry in os.scandir(above) if not entry.name.startswith("."))
    except OSError:
        return ""
    hint = nearest(missing.name, names)
    return f". {hint} (in {above})" if hint.startswith("Did") else ""
