"""Protocols that see what a module registers: its parameters, its buffers and its parts."""

from __future__ import annotations

from typing import Any, Protocol


class SeesRegistered(type(Protocol)):  # type: ignore[misc]
    """The type of runtime-checkable protocols with attributes that a torch module may have registered.

    A module finds what is registered by `__getattr__`. Since Python 3.12 `isinstance` asks for the attributes of a
    protocol without it, and says of a module with the right buffers that it is none of the kind.
    """

    def __instancecheck__(cls, instance: Any) -> bool:
        """Return whether a value has every attribute and method of the protocol."""
        names = getattr(cls, "__protocol_attrs__", None)  # of Python 3.12 and newer
        if names is None or not getattr(cls, "_is_protocol", False):
            return super().__instancecheck__(instance)
        return all(hasattr(instance, name) for name in names)
