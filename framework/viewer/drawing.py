"""Pictures of what a browser asks for: a piece of a view is rendered, and shown in the colours of an output."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.device import wait_for
from nerfloom.cameras.ndc import Ndc
from nerfloom.cameras.view import View
from nerfloom.evaluation.appearance import appearance_of, shown_appearance
from nerfloom.evaluation.evaluator import evaluation_background
from nerfloom.evaluation.outputs import Arrays, distance_range, kept_outputs, rendered_outputs, shown_output
from nerfloom.rendering.rendered import Picture
from nerfloom.viewer.crop import picture_within
from nerfloom.viewer.pace import Piece
from nerfloom.viewer.request import Request
from nerfloom.viewer.subject import Subject

NAMES = {"rgb": "rgb", "depth": "median_depth", "accumulation": "accumulation", "normals": "normals", "error": "error"}
"""Output of a request -> what is kept of a picture for it."""
Truth = Callable[[View, Tensor, Tensor], "Tensor | None"]
"""Function from a view, its picture (H, W, 3) and the background (3,) to the true image; None where it is unknown."""


def draw(subject: Subject, request: Request, piece: Piece, ndc: Ndc | None, truth: Truth | None = None) -> Arrays:
    """Return what is kept of a piece of a view for the output that is asked for.

    Args:
        subject: what is looked at.
        request: what is asked for.
        piece: rows at a stride.
        ndc: normalised device coordinates of the scene; None if it has none.
        truth: for the output `error`; where it is unknown, the rendered colours are kept.
    """
    model = subject.model
    camera = request.camera(piece.stride, (piece.top, piece.bottom), ndc).to(model.device)
    crop = request.crop if ndc is None else None
    view = View(camera, request.time if model.scene.moving else None, piece.rays)
    background = evaluation_background(model)
    if request.background is not None:
        background = background.new_tensor(request.background)
    with _appearance(subject, request.appearance), torch.no_grad():
        if request.output == "rgb" and crop is None:
            kept = rendered_outputs(model, view, background, ["rgb"], subject.unit)
        else:
            if crop is None:
                picture = model.render_view(view, background)
            else:
                picture = picture_within(model, view, crop, background)
            kept = _kept(subject, request, view, picture, background, truth)
    wait_for(model.device)
    return kept


def _kept(
    subject: Subject, request: Request, view: View, picture: Picture, background: Tensor, truth: Truth | None
) -> Arrays:
    name = NAMES[request.output]
    if name == "normals" and picture.normals is None:
        name = "rgb"
    if name != "error":
        return kept_outputs(picture, [name], subject.unit)
    found = None if truth is None else truth(view, picture.rgb, background)
    return kept_outputs(picture, ["rgb" if found is None else "error"], subject.unit, found)


def _appearance(subject: Subject, image: int | None) -> AbstractContextManager[None]:
    appearance = appearance_of(subject.model)
    if appearance is None or image is None or not 0 <= image < len(appearance.vectors):
        return nullcontext()
    return shown_appearance(subject.model, appearance.vectors[image].detach())


def colored(kept: Arrays, range_of_depth: tuple[float, float] | None = None) -> np.ndarray:
    """Return the picture (H, W, 3) uint8 of what was kept for one output.

    Args:
        kept: what was kept.
        range_of_depth: distances at the ends of the colours of depth, units of the input; found in `kept` if None.
    """
    name = next((name for name in kept if name != "accumulation"), "accumulation")
    ranges = {}
    if name == "median_depth":
        ranges[name] = distance_range([kept], name) if range_of_depth is None else range_of_depth
    return shown_output(kept, name, ranges)
