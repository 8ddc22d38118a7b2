"""Protocols that see a module's registered parameters, buffers and submodules."""

from __future__ import annotations

from typing import Any, Protocol


class SeesRegistered(type(Protocol)):  # type: ignore[misc]
    """Metaclass of runtime-checkable protocols with attributes that a torch module may register.

    A module looks up registered attributes in `__getattr__`. Since Python 3.12, `isinstance` does not call
    `__getattr__` for a protocol's attributes, and would reject a module with the right buffers.
    """

    def __instancecheck__(cls, instance: Any) -> bool:
        """Return whether a value has every attribute and method of the protocol."""
        names = getattr(cls, "__protocol_attrs__", None)  # Python 3.12 and newer
        if names is None or not getattr(cls, "_is_protocol", False):
            return super().__instancecheck__(instance)
        return all(hasattr(instance, name) for name in names)
