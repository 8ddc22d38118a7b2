"""Settings that are changed by name."""

from dataclasses import dataclass

import pytest

from nerfloom.base.changed import changed, refuse
from nerfloom.base.errors import ConfigError


@dataclass(frozen=True)
class Settings:
    size: int = 3
    last_step: float = 0.5

    shape = "round"  # an attribute of the class, and no setting


def test_values_replace_those_of_their_name_and_none_keeps_one() -> None:
    assert changed(Settings(), {"size": 0, "last_step": None, "unknown": None}, "a run") == Settings(0, 0.5)
    with pytest.raises(ConfigError, match="--other-size has no effect with a run"):
        changed(Settings(), {"size": 1, "other_size": 2}, "a run")
    with pytest.raises(ConfigError, match="--shape has no effect with a run"):
        changed(Settings(), {"shape": "square"}, "a run")


def test_only_values_that_are_given_are_refused() -> None:
    refuse({"size": None}, "a file")
    with pytest.raises(ConfigError, match="--last-step has no effect with a file"):
        refuse({"size": None, "last_step": 0.0}, "a file")
