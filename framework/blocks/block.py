"""A block of a large scene: a place, its cameras, and the run that learned from them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

Vector = tuple[float, float, float]
"""Three numbers."""
Affine = tuple[tuple[float, ...], ...]
"""Three rows of four numbers: red, green and blue as functions of red, green, blue and 1."""
IDENTITY: Affine = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
"""The affine function that changes no colour."""


@dataclass(frozen=True)
class Block:
    """A place, and the training images that show it. Lengths are in the input's frame and unit."""

    center: Vector
    """Mean position of the cameras that only this block is for."""
    radius: float
    """Maximum distance from the centre of cameras that see the block."""
    cameras: tuple[int, ...]
    """Indices of its training images, in the order of the data format. Neighbours share images."""


@dataclass(frozen=True)
class TrainedBlock(Block):
    """A block with its run."""

    run: Path
    """Folder of the run."""
    color: Affine = IDENTITY
    """Function of its colours that makes them match its neighbours' colours."""
