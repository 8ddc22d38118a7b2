"""Checks of the paths in `ns-train`'s flags, before the import of torch, which takes seconds."""

from __future__ import annotations

import os
from itertools import pairwise
from pathlib import Path

from nerfloom.base.config import TrainConfig
from nerfloom.base.errors import CheckpointError, ConfigError, DataError
from nerfloom.base.plain import read_yaml
from nerfloom.cli.flags import HELP
from nerfloom.training.run_path import check_data, check_writable


def check_paths(flags: list[str], recipe: Path | None = None, folder: Path | None = None) -> None:
    """Refuse paths that are missing or cannot be written.

    Args:
        flags: flags of the command.
        recipe: file of settings; None for a method's defaults.
        folder: folder of the run; None for a new one.

    Raises:
        ConfigError: if the run's folder cannot be written, the recipe cannot be read, or the teacher is missing.
        DataError: if the data is missing.
        CheckpointError: if the checkpoint to start from is missing.
    """
    if set(HELP) & set(flags):
        return
    settings = {} if recipe is None else read_yaml(recipe)
    data, recorded = _value(flags, "--data"), settings.get("data")
    if data is not None and data != "None":
        check_data(Path(data))
    elif data is None and isinstance(recorded, str) and not os.path.exists(recorded):
        raise DataError(f"the run's data {recorded} does not exist; give its new location: --data DIR")
    for name in ("--load-checkpoint", "--load-dir"):
        start = _value(flags, name)
        if start is not None and start != "None" and not os.path.exists(start):
            raise CheckpointError(f"{name} {start}: there is no such file or folder")
    teacher = _value(flags, "--teacher") or settings.get("teacher")
    if isinstance(teacher, str) and teacher != "None" and not os.path.exists(teacher):
        raise ConfigError(f"--teacher {teacher}: there is no such run or file; name another, or none: --teacher None")
    output = _value(flags, "--output-dir") or settings.get("output_dir") or TrainConfig.output_dir
    check_writable(folder or Path(str(output)), "the run's folder")


def _value(flags: list[str], name: str) -> str | None:
    """Return the last value of the flag `name`; None if it has none."""
    words: list[str] = []
    for flag in flags:
        known, equals, value = flag.partition("=") if flag.startswith("--") else (flag, "", "")
        words += [known.replace("_", "-") if flag.startswith("--") else flag, *([value] if equals else [])]
    values = [value for flag, value in pairwise(words) if flag == name and not value.startswith("--")]
    return values[-1] if values else None
