"""The end of training, as the trainer reports it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Outcome:
    """End of training: its reason and the last checkpoint."""

    reason: str
    """Why training stopped, as text."""
    stopped_by: int | None
    """Number of the signal that stopped training; None if no signal did."""
    checkpoint: Path | None
    """Path of the last checkpoint; None without a folder."""

    @property
    def interrupted(self) -> bool:
        """True if a signal stopped training."""
        return self.stopped_by is not None
