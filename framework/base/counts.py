"""Numbers of things in messages."""

from __future__ import annotations


def counted(number: int, what: str) -> str:
    """Return a `number` of things, such as "1,200 images" or "1 image"; `what` is their plural, which ends in s."""
    return f"{number:,} {what.removesuffix('s') if number == 1 else what}"
