"""Settings that follow from the names of those that a user gives."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from typing import TypeVar

from nerfloom.base.config import TrainConfig
from nerfloom.base.errors import FlagError

ConfigT = TypeVar("ConfigT", bound=TrainConfig)


def limited_as_given(config: ConfigT, given: Collection[str]) -> ConfigT:
    """Return settings without a limit of steps if a user gives seconds alone: a method's number of steps is a default.

    Args:
        config: the settings.
        given: names of the settings that the user gives.

    Raises:
        FlagError: if neither steps nor seconds have a limit, which schedules need.
    """
    if config.max_seconds is not None and "max_seconds" in given and "max_num_iterations" not in given:
        config = dataclasses.replace(config, max_num_iterations=None)
    if config.max_seconds is None and config.max_num_iterations is None:
        raise FlagError("--max-num-iterations None needs --max-seconds: learning rates follow the share that is spent")
    return config
