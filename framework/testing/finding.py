"""Results of checks."""

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
    """A line for people: the result and, if the check failed, the scene and the remedy."""

    def line(self) -> str:
        """Return the finding as a line of text."""
        return f"{'ok' if self.ok else 'WRONG':<6}{self.check}: {self.detail}"


class Fault(Exception):
    """Failure of a check, with a message on one line."""
