"""The trainer of benchmarks of speed."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from framework.base.registry import load_dataparser, load_method
from framework.data.data_folder import find_data
from framework.training.datasets import load_split
from framework.training.run import Run, create_folder
from framework.training.trainer import Trainer


def endless_trainer(method: str, data: Path, seconds: float, folder: Path) -> Trainer:
    """Return a trainer with the settings for a time budget, but without the budget.

    With a budget, the learning rate would fall over time, and a run that reached its end would not be typical.

    Args:
        method: name of the method.
        data: folder of the data set, whose format is recognised.
        seconds: time budget, seconds, for which the method chooses its settings.
        folder: folder in which the run's folder is created.

    Raises:
        DataError: if no format recognises the data.
    """
    data_folder, name = find_data(data)
    declared = load_method(method)
    config = dataclasses.replace(declared.config, data=data_folder, vis="none", max_seconds=seconds)
    run = Run(method, config, name, load_dataparser(name)(), folder / "run")
    train_set = load_split(run, "train")
    config, _ = declared.decided(config, train_set.scene)
    run = dataclasses.replace(run, config=dataclasses.replace(config, max_seconds=None))
    create_folder(run)
    trainer = Trainer(run, train_set, None)
    trainer.prepare()
    return trainer
