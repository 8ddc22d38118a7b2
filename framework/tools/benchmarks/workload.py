"""The training that benchmarks of speed measure."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from framework.base.registry import load_dataparser, load_method
from framework.data.data_folder import find_data
from framework.training.datasets import load_split
from framework.training.run import Run, create_folder
from framework.training.trainer import Trainer


def endless_trainer(method: str, data: Path, seconds: float, folder: Path) -> Trainer:
    """Build a trainer with the settings for a given time, but without its end.

    With `max_seconds` the learning rate falls with the clock: a run that ended while it is measured would not do what
    it does on the way.

    Args:
        method: name of the method.
        data: folder of the data set; its format is recognised.
        seconds: seconds of training for which the method chooses its settings.
        folder: where the run's folder is made.
    Raises: DataError where no format recognises the data.
    """
    found, name = find_data(data)
    declared = load_method(method)
    config = dataclasses.replace(declared.config, data=found, vis="none", max_seconds=seconds)
    run = Run(method, config, name, load_dataparser(name)(), folder / "run")
    train_set = load_split(run, "train")
    config, _ = declared.decide(config, train_set.scene)
    run = dataclasses.replace(run, config=dataclasses.replace(config, max_seconds=None))
    create_folder(run)
    trainer = Trainer(run, train_set, None)
    trainer.prepare()
    return trainer
