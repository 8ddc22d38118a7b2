"""Settings with some values changed by name, where a value without effect is refused."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

from nerfloom.base.errors import ConfigError

T = TypeVar("T")


def changed(settings: T, given: Mapping[str, Any], what: str) -> T:
    """Return the dataclass `settings` of `what` with the `given` values by name; None keeps a value.

    Raises:
        ConfigError: if there is no setting of a name.
    """
    new = {name: value for name, value in given.items() if value is not None}
    names = {field.name for field in dataclasses.fields(settings)}  # type: ignore[arg-type]
    refuse({name: value for name, value in new.items() if name not in names}, what)
    return dataclasses.replace(settings, **new)  # type: ignore[type-var]


def refuse(useless: Mapping[str, Any], what: str) -> None:
    """Refuse flags, `useless` values by name with underscores, that have no effect with `what`; None: not given.

    Raises:
        ConfigError: if a value is given.
    """
    for name, value in useless.items():
        if value is not None:
            raise ConfigError(f"--{name.replace('_', '-')} has no effect with {what}: leave it out")
