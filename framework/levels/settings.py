"""Settings of drawing a tree of Gaussians. This module does not import torch."""

from __future__ import annotations

import math
from dataclasses import dataclass

from nerfloom.base.errors import FlagError


@dataclass(frozen=True)
class DetailSettings:
    """Detail of pictures, and memory for it.

    Raises:
        FlagError: if a value is out of range.
    """

    level_error: float = 1.0
    """Largest standard deviation of a merged Gaussian on the image, pixels; 0: none is merged."""
    memory_limit: float = 2000.0
    """Memory for Gaussians, MB (1e6 bytes). Where it does not suffice, the level error is larger."""

    def __post_init__(self) -> None:
        if not 0 <= self.level_error < math.inf:
            raise FlagError(f"--level-error is {self.level_error:g}; it must be at least 0 and finite, in pixels")
        if not 0 < self.memory_limit < math.inf:
            raise FlagError(f"--memory-limit is {self.memory_limit:g}; it must be more than 0 and finite, in MB")
