"""A full-size picture that is refined piece by piece."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from nerfloom.evaluation.outputs import Arrays
from nerfloom.viewer.pace import Piece
from nerfloom.viewer.request import smaller


def enlarged(kept: Arrays, width: int, height: int) -> dict[str, np.ndarray]:
    """Return coarse arrays `kept` at the full size of `width` x `height` pixels; each pixel becomes a block."""
    found = {}
    for name, values in kept.items():
        rows, columns = values.shape[:2]
        found[name] = values[np.arange(height) * rows // height][:, np.arange(width) * columns // width]
    return found


def paste(canvas: Mapping[str, np.ndarray], kept: Arrays, piece: Piece) -> None:
    """Write the arrays `kept` of a `piece`, rows at a stride, into the full-size `canvas`, in place."""
    for name, whole in canvas.items():
        height, width = whole.shape[:2]
        columns, rows = smaller(width, height, piece.stride)
        sources = np.arange(height) * rows // height
        first, last = np.searchsorted(sources, [piece.top, piece.bottom])
        part = kept[name][sources[first:last] - piece.top]
        whole[first:last] = part[:, np.arange(width) * columns // width]
