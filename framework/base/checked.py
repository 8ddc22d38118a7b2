"""Construction of dataclasses from untrusted values, with each value checked against its field's type."""

from __future__ import annotations

import types
import typing
from typing import Any, Literal, TypeVar, Union

from nerfloom.base.errors import shown

T = TypeVar("T")


def checked(kind: type[T], values: Any) -> T:
    """Construct the dataclass `kind` from a dictionary of field `values`; anything else is refused.

    Raises:
        ValueError: if `values` is not a dictionary, or a value is missing, unknown or not of its field's type.
    """
    if not isinstance(values, dict):
        raise ValueError(f"{kind.__name__} is {shown(values)}; it must be a mapping of names to values")
    try:
        instance = kind(**values)
    except TypeError as error:
        raise ValueError(str(error)) from error
    for name, hint in typing.get_type_hints(kind).items():
        value = getattr(instance, name)
        if not is_instance_of(value, hint):
            raise ValueError(f"{kind.__name__}.{name} is {shown(value)}; it must be {shown(hint)}")
    return instance


def is_instance_of(value: Any, hint: Any) -> bool:
    """Return whether `value` is of the type `hint`: a class, union, `Literal` or tuple. A bool is no number."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (Union, types.UnionType):
        return any(is_instance_of(value, argument) for argument in arguments)
    if origin is Literal:
        return any(type(value) is type(argument) and value == argument for argument in arguments)
    if origin is tuple:
        inner = arguments[:1] * len(value) if arguments[-1] is Ellipsis and isinstance(value, tuple) else arguments
        return isinstance(value, tuple) and len(value) == len(inner) and all(map(is_instance_of, value, inner))
    if hint in (int, float):
        return isinstance(value, (int, float) if hint is float else int) and not isinstance(value, bool)
    return isinstance(value, hint)
