"""Arguments of functions from plain values, such as the values of a YAML file."""

from __future__ import annotations

import inspect
import math
import typing
from collections.abc import Callable
from typing import Any

from nerfloom.base.errors import ConfigError, nearest, shown
from nerfloom.base.plain import converted


def arguments_of(function: Callable[..., Any], values: Any, where: str, given: int = 0) -> dict[str, Any]:
    """Return keyword arguments of a function, each of the type that is annotated.

    Args:
        function: a function or a dataclass.
        values: mapping of the arguments' names to plain values; None for no arguments.
        where: name of the source in error messages.
        given: number of leading parameters that are not among the values.

    Raises:
        ConfigError: if the values are no mapping, or an argument is unknown, missing, of another type, or not finite.
    """
    if values is None:
        values = {}
    if not isinstance(values, dict):
        raise ConfigError(f"{where} is {shown(values)}; it must hold names and values, such as '{{name: value}}'")
    hints = typing.get_type_hints(function)
    parameters = list(inspect.signature(function).parameters.values())[given:]
    names = [parameter.name for parameter in parameters]
    for name in values:
        if name not in names:
            raise ConfigError(f"{where}: unknown key {shown(name)}. {nearest(shown(name), names)}")
    needed = [parameter.name for parameter in parameters if parameter.default is inspect.Parameter.empty]
    if missing := [name for name in needed if name not in values]:
        raise ConfigError(f"{where} needs {' and '.join(missing)}")
    found = {name: converted(value, hints[name], f"{where}: '{name}'") for name, value in values.items()}
    for name, value in found.items():
        if not _is_finite(value):
            raise ConfigError(f"{where}: '{name}' is {shown(values[name])}; its numbers must be finite")
    return found


def _is_finite(value: Any) -> bool:
    """Return whether all numbers in a value are finite."""
    if isinstance(value, tuple):
        return all(map(_is_finite, value))
    return not isinstance(value, float) or math.isfinite(value)
