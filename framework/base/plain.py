"""Settings as plain values, which YAML holds: numbers, strings, lists and dictionaries."""

from __future__ import annotations

import dataclasses
import os
import types
import typing
from pathlib import Path
from typing import Any, Literal, TypeVar, Union

import yaml

from nerfloom.base.config import AUTO, in_all_bases
from nerfloom.base.errors import ConfigError, nearest, one_line, shown
from nerfloom.base.from_nerfstudio import config_answer

T = TypeVar("T")


def to_plain(value: Any) -> Any:
    """Convert a `value` of a config to numbers, strings, lists and dictionaries, which the safe YAML dumper writes."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, (list, tuple)):
        return [to_plain(item) for item in value]
    return value


def from_plain(default: T, values: dict[str, Any], where: str) -> T:
    """Return a config with some fields replaced.

    Args:
        default: instance of a dataclass.
        values: plain values by field name, as read from YAML.
        where: name of the source in error messages.

    Raises:
        ConfigError: for an unknown key, with the nearest valid one, for a value of the wrong type, or for a setting of
            an earlier version (`GONE`) with another value than the one used now. A class may have such a setting again.
    """
    hints = typing.get_type_hints(type(default))
    names = {f.name for f in dataclasses.fields(default)}  # type: ignore[arg-type]
    gone = {key: now for key, now in in_all_bases(type(default), "GONE").items() if key not in names}
    changes = {}
    for key, value in values.items():
        if key in gone:
            continue
        if key not in names:
            name = key if isinstance(key, str) else shown(key)
            raise ConfigError(f"{where}: unknown key {shown(name)}. {nearest(name, names)}")
        current = getattr(default, key)
        if dataclasses.is_dataclass(current) and isinstance(value, dict):
            changes[key] = from_plain(current, value, f"{where}: {key}")
        else:
            changes[key] = converted(value, hints[key], f"{where}: '{key}'")
    config = dataclasses.replace(default, **changes)  # type: ignore[type-var]
    for key in (key for key in values if key in gone):
        now = gone[key](config) if callable(gone[key]) else gone[key]
        if values[key] != to_plain(now):
            raise ConfigError(f"{where}: '{key}' is {shown(values[key])}, but now it is {now}; leave it out")
    return config


def converted(value: Any, hint: Any, where: str) -> Any:
    """Convert a plain value, such as one read from YAML, to an annotated type.

    Args:
        value: the value.
        hint: the type: a class, `Path`, or a union, `Literal` or tuple of types.
        where: name of the value in error messages.

    Raises:
        ConfigError: if the value is not of this type.
    """
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        if Literal["auto"] in arguments and (value == AUTO or value is None):  # null in files of older runs
            return AUTO
        return converted(value, next(a for a in arguments if a not in (type(None), Literal["auto"])), where)
    if origin is Literal:
        if value in arguments:
            return value
        raise ConfigError(f"{where} is {shown(value)}; it must be one of {', '.join(map(str, arguments))}")
    if origin is tuple and isinstance(value, (list, tuple)):
        inner = arguments[:1] * len(value) if arguments[-1] is Ellipsis else arguments
        if len(inner) == len(value):
            return tuple(converted(item, kind, where) for item, kind in zip(value, inner, strict=True))
    if hint is Path and isinstance(value, str) and "\0" not in value:
        return Path(os.path.expanduser(value))
    if hint is float and isinstance(value, (str, int, float)) and not isinstance(value, bool):
        try:
            return float(value)  # YAML 1.1 reads 1e-3 as a string
        except (ValueError, OverflowError):
            pass
    if isinstance(hint, type) and (_is_count(value) if hint is int else isinstance(value, hint)):
        return value
    raise ConfigError(f"{where} is {shown(value)}; it must be {getattr(hint, '__name__', hint)}")


def _is_count(value: Any) -> bool:
    """Return whether a value is an integer of at most 64 bits, and not a bool."""
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) < 2**63


class _PlainLoader(yaml.SafeLoader):
    """PyYAML's safe loader without aliases: a few lines of aliases can expand beyond memory."""

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("it has an alias (*name); write the value out")
        return super().compose_node(parent, index)


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML file that holds a mapping, with the safe loader and without aliases.

    Raises:
        ConfigError: if the file is missing, is not YAML or does not hold a mapping.
    """
    try:
        text = path.read_text(encoding="utf-8")
        if (answer := config_answer(text)) is not None:
            raise ConfigError(f"{path} {answer}")
        values = yaml.load(text, _PlainLoader)
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from error
    except ConfigError:
        raise
    except Exception as error:  # not only YAMLError: bad text, dates and nesting raise others, `!!float ''` IndexError
        raise ConfigError(f"{path} is not plain YAML: {one_line(error)}") from error
    if not isinstance(values, dict):
        raise ConfigError(f"{path} must hold keys and values, such as 'method: instant-ngp'")
    return values
