"""A faster file of a run's scene, such as its octree, which is drawn while the camera moves."""

from __future__ import annotations

from nerfloom.evaluation.outputs import Arrays
from nerfloom.training.loaded import Loaded
from nerfloom.viewer.drawing import draw
from nerfloom.viewer.pace import Piece
from nerfloom.viewer.request import Request

SHARED = ("rgb", "depth", "accumulation")
"""Outputs that look alike in the run and in the file."""


def is_shared(request: Request) -> bool:
    """Return whether a file can show the picture of a `request`, with arrays of the same names as the run's."""
    return request.output in SHARED and not request.overlay


def draw_in_motion(loaded: Loaded, quick: Loaded, request: Request, piece: Piece) -> Arrays:
    """Draw a piece of a view of a file in place of a run.

    Args:
        loaded: the run.
        quick: the file; its scene may be placed in another way.
        request: the view, in the frame of the run's scene.
        piece: rows at a stride.
    """
    there = quick.scaled(loaded.scale)
    return draw(there, request.moved(*loaded.placement.similarity_to(there.placement)), piece, None)
