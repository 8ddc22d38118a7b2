"""The flags of a method as a table: name, default, allowed range and help, read from its settings class."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import math
import textwrap
import typing
from collections.abc import Iterator
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union

from nerfloom.base.config import AUTO, LEFT_TO_DATA, TrainConfig
from nerfloom.cli.flag_groups import groups_of

NO_VALUES = (type(None), Literal["auto"], LEFT_TO_DATA, ...)
"""Arguments of a type that say nothing of its values."""


def flag_tables(name: str, config: TrainConfig) -> str:
    """Return Markdown with one table for each group of flags, in the order of `ns-train METHOD --help-all`.

    Args:
        name: the method's name.
        config: its default settings.
    """
    kind = type(config)
    helps, ranges, hints = help_texts(kind), ranges_of(kind), typing.get_type_hints(kind, include_extras=True)
    parts = []
    for title, members in groups_of(kind):
        if not members:
            continue
        rows = ["| flag | default | allowed | |", "|---|---|---|---|"]
        for member in members:
            value = getattr(config, member)
            if dataclasses.is_dataclass(value):
                rows += nested_rows(member, value)
                continue
            shown, allowed = default_of(value, hints[member]), allowed_of(hints[member], ranges.get(member))
            rows.append(row(member, shown, allowed, helps.get(member, "")))
        parts.append(f"### {'Of ' + name if title == 'METHOD' else title.capitalize()}\n\n" + "\n".join(rows))
    return "\n\n".join(parts)


def nested_rows(member: str, value: Any) -> list[str]:
    """Return the rows of a settings class within the settings, such as --machine.seed."""
    helps, hints = help_texts(type(value)), typing.get_type_hints(type(value), include_extras=True)
    return [
        row(
            f"{member}.{f.name}",
            default_of(getattr(value, f.name), hints[f.name]),
            allowed_of(hints[f.name], None),
            helps.get(f.name, ""),
        )
        for f in dataclasses.fields(value)
    ]


def row(member: str, shown: str, allowed: str, text: str) -> str:
    """Return a row of a table; text that Markdown or the table could misread is escaped."""
    escaped = " ".join(text.split()).replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")
    return f"| `--{member.replace('_', '-')}` | {shown} | {allowed} | {escaped} |"


def default_of(value: Any, hint: Any) -> str:
    """Return a default as the command line takes it."""
    if value == AUTO and LEFT_TO_DATA in getattr(hint, "__metadata__", ()):
        return "*decided by the data*"
    if value is None:
        return "*none*"
    if isinstance(value, tuple):
        return f"`{' '.join(map(str, value))}`"
    return f"`{value}`"


def allowed_of(hint: Any, span: tuple[float, float] | None) -> str:
    """Return the allowed values of a setting: its words, or its range."""
    if span is not None:
        least, most = (_number(end) for end in span)
        return f"at least {least}" if math.isinf(span[1]) else f"{least} to {most}"
    words = choices(hint)
    return " ".join(f"`{word}`" for word in words) if words else _kind(hint)


def choices(hint: Any) -> tuple[Any, ...]:
    """Return the words that a setting may be; none if it is not a choice of words."""
    if typing.get_origin(hint) is Literal:
        return typing.get_args(hint)
    found = [choices(argument) for argument in typing.get_args(hint) if argument not in NO_VALUES]
    return next(filter(None, found), ())


def _kind(hint: Any) -> str:
    """Return the kind of a setting's values, in words."""
    arguments = [argument for argument in typing.get_args(hint) if argument not in NO_VALUES]
    if typing.get_origin(hint) in (Union, UnionType) or hasattr(hint, "__metadata__"):
        return _kind(arguments[0])
    if typing.get_origin(hint) is tuple:
        return f"{_kind(arguments[0])}s"
    return {bool: "`True` `False`", int: "integer", float: "number", Path: "path", str: "text"}.get(hint, "")


def _number(value: float) -> str:
    return f"{value:,}" if isinstance(value, int) or not float(value).is_integer() else f"{int(value):,}"


def ranges_of(kind: type) -> dict[str, tuple[float, float]]:
    """Return the allowed range of each numeric setting; a class overrides those that it inherits."""
    found: dict[str, tuple[float, float]] = {}
    for base in reversed(kind.__mro__):
        found |= vars(base).get("RANGES", {})
    return found


def help_texts(kind: type) -> dict[str, str]:
    """Return the string under each field of a class and of those it derives from."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if dataclasses.is_dataclass(base):
            found |= dict(_strings_under_fields(base))
    return found


def _strings_under_fields(kind: type) -> Iterator[tuple[str, str]]:
    (node,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(node, ast.ClassDef)
    for field, after in zip(node.body, node.body[1:], strict=False):
        named = isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
        if named and isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
            yield field.target.id, str(after.value.value)  # type: ignore[attr-defined, union-attr]
