"""What a check says."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """The outcome of one check of a method."""

    check: str
    """The check's name."""
    ok: bool
    """Whether the method passed it."""
    detail: str
    """One line: what was found, where, and, if it is wrong, what to do."""

    def line(self) -> str:
        """The finding as it is printed."""
        return f"{'ok' if self.ok else 'WRONG':<6}{self.check}: {self.detail}"


class Fault(Exception):
    """What a check found wrong, in one line."""
