"""Decisions on settings that depend on the data."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, TypeVar, get_type_hints

from nerfloom.base.config import AUTO, LEFT_TO_DATA, TrainConfig

ConfigT = TypeVar("ConfigT", bound=TrainConfig)


@dataclass(frozen=True)
class Decision:
    """A record, for the user, of a setting that was chosen from the data."""

    option: str
    """Name of the setting in words."""
    choice: str
    """The chosen value in words."""
    reason: str
    """Reason, as a clause that follows "as"."""

    def line(self) -> str:
        """Return the decision as a line of text."""
        return f"  {self.option}: {self.choice}, as {self.reason}"


@dataclass(frozen=True)
class Choice:
    """A value for a setting that the user has left open."""

    setting: str
    """Name of the config's field."""
    value: Any
    """The chosen value."""
    reason: str
    """Reason, as a clause that follows "as"."""
    option: str | None = None
    """Name of the setting in words; None for the field's name with spaces."""
    shown: str | None = None
    """The value in words; None for the value as text."""

    def decision(self) -> Decision:
        """Return the record of this choice."""
        shown = f"{self.value:g}" if isinstance(self.value, float) else f"{self.value}"
        if isinstance(self.value, bool):
            shown = "on" if self.value else "off"
        return Decision(self.option or self.setting.replace("_", " "), self.shown or shown, self.reason)


def is_open(value: Any) -> bool:
    """Return whether `value` leaves a setting to the data."""
    return isinstance(value, str) and value == AUTO


def left_open(config: TrainConfig) -> list[str]:
    """Return the names of the `Auto` settings that are still left to the data."""
    kinds = get_type_hints(type(config), include_extras=True)
    may_be = [name for name, kind in kinds.items() if LEFT_TO_DATA in getattr(kind, "__metadata__", ())]
    return [name for name in may_be if is_open(getattr(config, name))]


def fill(config: ConfigT, *choices: Choice) -> tuple[ConfigT, list[Decision]]:
    """Fill in the settings that are still open. Other settings stay unchanged and are not reported.

    Args:
        choices: a value for each setting that may be open.

    Returns:
        the settings, and the decisions that were made.
    """
    applied = [choice for choice in choices if is_open(getattr(config, choice.setting))]
    values = {choice.setting: choice.value for choice in applied}
    return dataclasses.replace(config, **values), [choice.decision() for choice in applied]
