"""Another run or file of the same scene: drawn in place of the first, or beside it, with a divider between them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.cameras.ndc import Ndc
from nerfloom.cameras.view import View
from nerfloom.evaluation.outputs import Arrays
from nerfloom.training.loaded import Loaded
from nerfloom.viewer.drawing import Truth, draw
from nerfloom.viewer.pace import Piece
from nerfloom.viewer.request import Request

COLOR = (255, 190, 0)
"""Colour of the divider."""


def check_beside(loaded: Loaded, second: Loaded) -> None:
    """Check that two runs or files, `loaded` and `second`, can be shown side by side.

    Raises:
        ConfigError: if one of them is in normalised device coordinates, where no similarity relates two frames.
    """
    for one in (loaded, second):
        if one.model.scene.warped:
            raise ConfigError(f"{one.origin} is in normalised device coordinates (--ndc): it can only be shown alone")


def draw_other(loaded: Loaded, other: Loaded, request: Request, piece: Piece, truth: Truth | None = None) -> Arrays:
    """Draw a piece of a view of another run or file: the arrays that the requested output needs.

    Args:
        loaded: the first run.
        other: the other one, possibly with another placement of its scene.
        request: the view, in the frame of the first run's scene.
        piece: rows at a stride.
        truth: true images, as in `draw`.
    """
    there = other.scaled(loaded.scale)
    return draw(there, request.moved(*loaded.placement.similarity_to(there.placement)), piece, None, truth)


def draw_beside(
    loaded: Loaded, second: Loaded | None, request: Request, piece: Piece, ndc: Ndc | None, truth: Truth | None = None
) -> Arrays:
    """Draw a piece of a view of one run, or of two with a divider: the arrays that the requested output needs.

    Args:
        loaded: the first run, left of the divider.
        second: the second run; None for the first alone.
        request: the view, in the frame of the first run's scene.
        piece: rows at a stride.
        ndc: normalised device coordinates of the scene; None if it has none.
        truth: true images of the first run for the output `error` and the overlay. They count for both
            runs, because the second may have refined its cameras.
    """
    if second is None or request.divider is None or request.divider >= 1:
        return draw(loaded, request, piece, ndc, truth)

    def truth_here(view: View, rgb: Tensor, background: Tensor) -> Tensor | None:
        camera = request.camera(piece.stride, (piece.top, piece.bottom))
        return None if truth is None else truth(replace(view, camera=camera, time=request.time), rgb, background)

    right = draw_other(loaded, second, request, piece, truth_here)
    return joined(draw(loaded, request, piece, None, truth), right, request.divider)


def joined(left: Arrays, right: Arrays, divider: float) -> Arrays:
    """Join arrays (H, W, ...) of the picture `left` of the fraction `divider` with the picture `right` of it."""
    found = {}
    for (name, one), other in zip(left.items(), right.values(), strict=True):
        column = round(divider * one.shape[1])
        found[name] = np.concatenate([one[:, :column], other[:, column:]], axis=1)
    return found


def with_divider(picture: np.ndarray, divider: float | None) -> np.ndarray:
    """Return a `picture` (H, W, 3) uint8 with a line of two pixels at the fraction `divider`; None for none."""
    if divider is None:
        return picture
    column = round(divider * picture.shape[1])
    found = picture.copy()
    found[:, max(column - 1, 0) : column + 1] = COLOR
    return found
