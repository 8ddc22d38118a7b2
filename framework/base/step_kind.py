"""The kind of a training step: whether steps repeat each other."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass


@dataclass(frozen=True)
class StepKind:
    """All that a training step depends on besides the values of tensors that stay where they are.

    Steps of equal kinds run the same operations on tensors of the same sizes, so that one of them can be recorded and
    repeated (`nerfloom.training.graphs`).
    """

    of: tuple[Hashable, ...] = ()
    """Everything else that decides which operations run."""
    varies: str | None = None
    """Why steps do not repeat each other, in words that follow "because"; None if they do."""
