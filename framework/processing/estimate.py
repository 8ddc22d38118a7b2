"""Rough durations in words."""

from __future__ import annotations


def about(seconds: float) -> str:
    """Return an approximate duration of `seconds` in words, such as ``about 40 s`` or ``about 1 h 05 min``."""
    if seconds < 99.5:
        return f"about {seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"about {minutes} min" if minutes < 100 else f"about {minutes // 60} h {minutes % 60:02d} min"
