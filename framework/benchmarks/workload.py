"""The trainer for benchmarks of speed."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from nerfloom.base.device import choose_device
from nerfloom.registry import load_method
from nerfloom.training.datasets import load_split
from nerfloom.training.run import Run, create_folder
from nerfloom.training.trainer import Trainer


def endless_trainer(run: Run, seconds: float, folder: Path) -> Trainer:
    """Return a trainer with the settings for a time budget, but without the budget itself.

    With a budget, the learning rate would fall over time, and a run that reaches its end would not be typical.

    Args:
        run: the run to train; its own budget and folder are not used.
        seconds: time budget, seconds, for the method's choice of settings.
        folder: parent of the run's folder.
    """
    config = dataclasses.replace(run.config, vis="none", max_seconds=seconds)
    run = dataclasses.replace(run, config=config, folder=folder / "run")
    train_set = load_split(run, "train").to(choose_device(run.config.machine))
    config, _ = load_method(run.method).decided(config, train_set.scene)
    run = dataclasses.replace(run, config=dataclasses.replace(config, max_seconds=None))
    create_folder(run)
    trainer = Trainer.of(run, train_set)
    trainer.prepare()
    return trainer
