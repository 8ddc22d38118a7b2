"""Dataclasses from values out of files that nobody has checked: each value must be what its field says."""

from __future__ import annotations

import types
import typing
from typing import Any, Literal, TypeVar, Union

from framework.base.errors import shown

T = TypeVar("T")


def checked(kind: type[T], values: Any) -> T:
    """A dataclass made of a dictionary.

    Raises: ValueError that says which value is missing, unknown, or not of its field's type.
    """
    if not isinstance(values, dict):
        raise ValueError(f"{kind.__name__} is {shown(values)}; it must be names and values")
    try:
        made = kind(**values)
    except TypeError as error:
        raise ValueError(str(error)) from error
    for name, hint in typing.get_type_hints(kind).items():
        value = getattr(made, name)
        if not is_of(value, hint):
            raise ValueError(f"{kind.__name__}.{name} is {shown(value)}; it must be {shown(hint)}")
    return made


def is_of(value: Any, hint: Any) -> bool:
    """Whether a value is of an annotated type: a class, or a union, literals or a tuple of such; True is no number."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (Union, types.UnionType):
        return any(is_of(value, argument) for argument in arguments)
    if origin is Literal:
        return any(type(value) is type(argument) and value == argument for argument in arguments)
    if origin is tuple:
        inner = arguments[:1] * len(value) if arguments[-1] is Ellipsis and isinstance(value, tuple) else arguments
        return isinstance(value, tuple) and len(value) == len(inner) and all(map(is_of, value, inner))
    if hint in (int, float):
        return isinstance(value, (int, float) if hint is float else int) and not isinstance(value, bool)
    return isinstance(value, hint)
