"""The kind of a training step, which decides whether steps can be captured and replayed."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass


@dataclass(frozen=True)
class StepKind:
    """Everything that a training step depends on, except the values of tensors at fixed addresses.

    Steps of equal kinds run the same operations on tensors of the same sizes, so that one of them can be captured and
    replayed (`nerfloom.training.graphs`).
    """

    of: tuple[Hashable, ...] = ()
    """Values that decide which operations run."""
    varies: str | None = None
    """Why steps cannot be replayed, as a clause that follows "because"; None if they can."""
