"""Gaussians that are read part by part, so that a scene may be larger than memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from nerfloom.splats.gaussians import Gaussians, Splats
from nerfloom.splats.look import Look


@dataclass(frozen=True)
class GaussianStream:
    """Gaussians in parts, which can be read several times."""

    parts: Callable[[int], Iterator[Gaussians]]
    """Reads all Gaussians from the start, at most the given number at a time, on the CPU. Degrees of harmonics may
    differ, and Gaussians may not be finite."""
    look: Look
    """The settings of drawing."""

    @classmethod
    def of(cls, splats: Splats) -> GaussianStream:
        """Return Gaussians that are in memory.

        Args:
            splats: the Gaussians and their settings of drawing.
        """
        return cls(splats.gaussians.sliced, splats.look)
