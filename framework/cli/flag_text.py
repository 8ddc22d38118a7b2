"""Flags as the help of a command shows them: without the source's line breaks, and without a None that says nothing."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any, get_args

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

NOTHING = ("None", "")
"""Defaults that are not shown: the text says what happens if the flag is not given."""


def plain_flags() -> ConstructorRegistry:
    """Return rules with which tyro shows the flags of every dataclass plainly."""
    registry = ConstructorRegistry()
    asked: list[StructTypeInfo] = []

    def rule(info: StructTypeInfo) -> StructConstructorSpec | None:
        if asked or not dataclasses.is_dataclass(info.type):
            return None
        asked.append(info)  # so that tyro's own rule answers
        try:
            spec: Any = ConstructorRegistry.get_struct_spec(info)
        finally:
            asked.clear()
        return dataclasses.replace(spec, fields=tuple(map(plain, spec.fields)))

    registry.struct_rule(rule)
    hide_none(registry)
    return registry


def plain(field: StructFieldSpec, **shown: Any) -> StructFieldSpec:
    """Return a field whose help has no line breaks of the source, and no default of None.

    Args:
        field: the field.
        shown: further arguments of `tyro.conf.arg`.
    """
    annotated: Any = Annotated[field.type, tyro.conf.arg(**{"help_behavior_hint": _default, **shown})]
    return dataclasses.replace(field, type=annotated, helptext=partial(unwrapped, field.helptext))


def _default(label: str) -> str:
    return "" if label in NOTHING else f"(default: {label})"


def unwrapped(text: str | Callable[[], str | None] | None) -> str | None:
    """Return a help text without the line breaks of the source, which is read only when the text is shown.

    Args:
        text: the text, or a function that reads it.
    """
    text = text() if callable(text) else text
    return text and re.sub(r"(?<!\n)\n(?!\n)", " ", text)


def hide_none(registry: ConstructorRegistry) -> None:
    """Add a rule with which the values of a flag are shown without None, which it takes nevertheless.

    Args:
        registry: where the rule is added.
    """
    asked: list[PrimitiveTypeInfo] = []

    def rule(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
        if asked or type(None) not in get_args(info.type):
            return None
        asked.append(info)  # so that tyro's own rule answers
        try:
            spec: Any = ConstructorRegistry.get_primitive_spec(info)
        finally:
            asked.clear()
        shown = spec.metavar.removeprefix("{None}|").replace("{None,", "{")
        return dataclasses.replace(spec, metavar=shown)

    registry.primitive_rule(rule)
