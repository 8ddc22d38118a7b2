"""Rules for tyro's flags: no uninformative None in the help, and our errors instead of tyro's."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Annotated, Any, get_args

import tyro
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, StructConstructorSpec, StructFieldSpec

from nerfloom.base.config import AUTO, LEFT_TO_DATA
from nerfloom.base.errors import ConfigError

DECIDED = "(default: decided by the data)"


class RefusedSettings(Exception):
    """Invalid values of settings. Not a ValueError, which tyro would print in a box."""


def plain_flags() -> ConstructorRegistry:
    """Return rules for plain help. With them `tyro.cli` raises RefusedSettings where settings raise ConfigError."""
    registry = ConstructorRegistry()
    registry.struct_rule(_amended(ConstructorRegistry.get_struct_spec, _plain))
    registry.primitive_rule(_amended(ConstructorRegistry.get_primitive_spec, _without_none))
    return registry


def _amended(answer: Callable[[Any], Any], amend: Callable[[Any, Any], Any]) -> Callable[[Any], Any]:
    """Return a rule that amends the answer of tyro's own rules."""
    asked: list[Any] = []

    def rule(info: Any) -> Any:
        if asked:  # tyro's own rules answer
            return None
        asked.append(info)
        try:
            return amend(info, answer(info))
        finally:
            asked.clear()

    return rule


def _plain(info: Any, spec: StructConstructorSpec | None) -> StructConstructorSpec | None:
    """Return the flags of a dataclass with their help text."""
    if not dataclasses.is_dataclass(info.type) or not isinstance(spec, StructConstructorSpec):
        return spec

    @functools.wraps(spec.instantiate)
    def made(**values: Any) -> Any:
        try:
            return spec.instantiate(**values)
        except ConfigError as error:
            raise RefusedSettings(str(error)) from error

    return StructConstructorSpec(made, tuple(map(_plain_field, spec.fields)))


def _plain_field(field: StructFieldSpec) -> StructFieldSpec:
    """Return a field with its help text on one line, and its default if informative."""
    is_open = field.default == AUTO and LEFT_TO_DATA in getattr(field.type, "__metadata__", ())
    shown: Any = Annotated[field.type, tyro.conf.arg(help_behavior_hint=DECIDED if is_open else _default)]
    return dataclasses.replace(field, type=shown, helptext=lambda: _on_one_line(field.helptext))


def _on_one_line(text: str | Callable[[], str | None] | None) -> str | None:
    text = text() if callable(text) else text  # the source is read only if the text is shown
    return text and " ".join(text.split())


def _default(label: str) -> str:
    """Return the text for a default; empty for None and empty values, which the help text explains."""
    return "" if label in ("None", "") else f"(default: {label})"


def _without_none(info: Any, spec: Any) -> Any:
    """Return a specification with help that omits the None that the flag also takes."""
    if not isinstance(spec, PrimitiveConstructorSpec) or type(None) not in get_args(info.type):
        return spec
    return dataclasses.replace(spec, metavar=spec.metavar.removeprefix("{None}|").replace("{None,", "{"))
