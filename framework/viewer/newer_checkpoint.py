"""Newer checkpoints of a run that is looked at."""

from __future__ import annotations

from pathlib import Path

from nerfloom.base.errors import NerfloomError
from nerfloom.training.checkpoint import FOLDER, list_checkpoints
from nerfloom.training.loaded import Loaded
from nerfloom.training.trained import load_parameters


def newer_checkpoint(folder: Path, seen: Path | None) -> Path | None:
    """Return the newest checkpoint in a run's `folder`, unless it was `seen` before."""
    try:
        newest = list_checkpoints(folder / FOLDER)[-1:]
    except OSError:
        return None
    return newest[0] if newest and newest[0] != seen else None


def reloaded(loaded: Loaded, checkpoint: Path) -> Loaded | str:
    """Return the run `loaded` with parameters of a newer `checkpoint`, or the reason why it cannot be read."""
    try:
        return load_parameters(loaded.run, checkpoint)
    except (NerfloomError, OSError) as error:
        return f"{checkpoint.name} cannot be shown: {error}"
