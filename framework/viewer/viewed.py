"""The subject of a viewer: a model, in training or trained, and where it comes from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerfloom.base.errors import NerfloomError
from nerfloom.cameras.poses import Placement
from nerfloom.model import Model
from nerfloom.training.checkpoint import FOLDER, list_checkpoints
from nerfloom.training.run import Run
from nerfloom.training.trained import Trained, load_trained
from nerfloom.training.trainer import Trainer


@dataclass(frozen=True)
class Subject:
    """A model that is looked at."""

    run: Run
    """Method, settings, data and folder."""
    model: Model[Any]
    """The model."""
    placement: Placement
    """Placement of the input in the scene."""
    step: int
    """Number of training steps done; a picture of another step is out of date."""

    @property
    def unit(self) -> float:
        """Units of the input per scene unit."""
        return 1 / self.placement.scale


def of_trained(trained: Trained) -> Subject:
    """Return the subject of a loaded run.

    Args:
        trained: the run.
    """
    state = trained.content.get("state")
    step = state.get("step", 0) if isinstance(state, dict) else 0
    return Subject(trained.run, trained.model, trained.placement, step if isinstance(step, int) else 0)


def of_trainer(trainer: Trainer) -> Subject:
    """Return the subject of a run in training, at its present step.

    Args:
        trainer: the run's trainer.
    """
    return Subject(trainer.run, trainer.model, trainer.train_set.placement, trainer.state.step)


def newer_checkpoint(folder: Path, seen: Path | None) -> Path | None:
    """Return the newest checkpoint in a run's folder if it is not the one that was seen.

    Args:
        folder: the run's folder.
        seen: path of the checkpoint that was loaded or tried last; None if none was.
    """
    try:
        newest = list_checkpoints(folder / FOLDER)[-1:]
    except OSError:
        return None
    return newest[0] if newest and newest[0] != seen else None


def reloaded(subject: Subject, checkpoint: Path) -> Subject | str:
    """Return the subject with the parameters of a newer checkpoint, or the reason why they cannot be read.

    Args:
        subject: what is looked at.
        checkpoint: file of the newer parameters.
    """
    config = subject.run.config
    try:
        trained = load_trained(subject.run.folder, checkpoint, config.machine.device_type, config.data)
    except (NerfloomError, OSError) as error:
        return f"{checkpoint.name} cannot be shown: {error}"
    return of_trained(trained)
