"""Newer checkpoints of a run that is looked at."""

from __future__ import annotations

from pathlib import Path

from nerfloom.base.errors import NerfloomError
from nerfloom.training.checkpoint import FOLDER, list_checkpoints
from nerfloom.training.loaded import Loaded
from nerfloom.training.trained import load_parameters


def newer_checkpoint(folder: Path, seen: Path | None) -> Path | None:
    """Return the newest checkpoint in a run's folder, unless it is the one already seen.

    Args:
        folder: the run's folder.
        seen: checkpoint loaded or tried last; None if there was none.
    """
    try:
        newest = list_checkpoints(folder / FOLDER)[-1:]
    except OSError:
        return None
    return newest[0] if newest and newest[0] != seen else None


def reloaded(loaded: Loaded, checkpoint: Path) -> Loaded | str:
    """Return a run with the parameters of a newer checkpoint, or the reason why they cannot be read.

    Args:
        loaded: the run that is looked at.
        checkpoint: file of the newer parameters.
    """
    try:
        return load_parameters(loaded.run, checkpoint)
    except (NerfloomError, OSError) as error:
        return f"{checkpoint.name} cannot be shown: {error}"
