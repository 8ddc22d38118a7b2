"""The limit of steps of a run with a limit of seconds."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from typing import TypeVar

from nerfloom.base.config import TrainConfig
from nerfloom.base.errors import FlagError

ConfigT = TypeVar("ConfigT", bound=TrainConfig)


def limited_as_given(config: ConfigT, given: Collection[str]) -> ConfigT:
    """Remove the default limit of steps if the settings `given` by the user only limit the seconds.

    Raises:
        FlagError: if neither steps nor seconds are limited; schedules need a limit.
    """
    if config.max_seconds is not None and "max_seconds" in given and "max_num_iterations" not in given:
        config = dataclasses.replace(config, max_num_iterations=None)
    if config.max_seconds is None and config.max_num_iterations is None:
        raise FlagError("--max-num-iterations None needs --max-seconds: learning rates follow the spent budget")
    return config
