"""Settings that are left to the data, and what became of each."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from framework.base.config import TrainConfig

ConfigT = TypeVar("ConfigT", bound="TrainConfig")


@dataclass(frozen=True)
class Decision:
    """What became of an option that was left to the data."""

    option: str
    """What people call it."""
    choice: str
    """What was chosen."""
    reason: str
    """Why, as the rest of a sentence after "as"."""

    def line(self) -> str:
        """Return one line for people."""
        return f"  {self.option}: {self.choice}, as {self.reason}"


@dataclass(frozen=True)
class Choice:
    """A value for a setting that was not given."""

    setting: str
    """Name of the config's field."""
    value: Any
    """What it becomes."""
    reason: str
    """Why, as the rest of a sentence after "as"."""
    option: str | None = None
    """What people call the setting; its name with spaces if None."""
    shown: str | None = None
    """The value for people; its own text if None."""

    def decision(self) -> Decision:
        """Return the record of this choice."""
        shown = f"{self.value:g}" if isinstance(self.value, float) else f"{self.value}"
        if isinstance(self.value, bool):
            shown = "on" if self.value else "off"
        return Decision(self.option or self.setting.replace("_", " "), self.shown or shown, self.reason)


def is_open(value: Any) -> bool:
    """Return whether a setting's value leaves it to the data."""
    return value is None or value == "auto"


def fill(config: ConfigT, *choices: Choice) -> tuple[ConfigT, list[Decision]]:
    """Fill in the settings that are still open; those that were given stay, and are not reported.

    Args:
        config: a method's settings.
        choices: a value for each setting that may be open.
    Returns: the settings, and what was decided.
    """
    made = [choice for choice in choices if is_open(getattr(config, choice.setting))]
    values = {choice.setting: choice.value for choice in made}
    return dataclasses.replace(config, **values), [choice.decision() for choice in made]
