"""Drawing of requested pictures: a piece of a view is rendered, and shown in the colours of an output."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.device import wait_for
from nerfloom.cameras.ndc import Ndc
from nerfloom.cameras.view import View
from nerfloom.evaluation.appearance import shown_appearance
from nerfloom.evaluation.outputs import (
    ERROR,
    Arrays,
    distance_range,
    is_number,
    kept_outputs,
    rendered_outputs,
    shown_output,
)
from nerfloom.rendering.outputs import FIXED, MEDIAN_DEPTH, RGB
from nerfloom.rendering.rendered import Picture
from nerfloom.training.loaded import Loaded
from nerfloom.viewer.crop import picture_within
from nerfloom.viewer.pace import Piece
from nerfloom.viewer.request import Request

DEPTH, FLAWS = "depth", "error"
"""Outputs with a special meaning in the viewer: the median depth, and the difference from a photograph."""
Truth = Callable[[View, Tensor, Tensor], "Tensor | None"]
"""Function from a view, its picture (H, W, 3) and the background (3,) to the true image; None if unknown."""


def draw(loaded: Loaded, request: Request, piece: Piece, ndc: Ndc | None, truth: Truth | None = None) -> Arrays:
    """Return the part of a piece of a view that the requested output needs.

    Args:
        loaded: the model and its run.
        piece: rows at a stride.
        ndc: normalised device coordinates of the scene; None if it has none.
        truth: true images for the output `error` and the overlay; where unknown, the rendered colours are returned.
    """
    model = loaded.model
    camera = request.camera(piece.stride, (piece.top, piece.bottom), ndc).to(model.device)
    crop = request.crop if ndc is None else None
    view = View(camera, (request.time or 0.0) if model.scene.moving else None, piece.rays)
    background = model.background
    if request.background is not None:
        background = background.new_tensor(request.background)
    with _appearance(loaded, request.appearance), torch.no_grad():
        if request.output == RGB.name and crop is None and not request.overlay:
            kept = rendered_outputs(model, view, background, [RGB], loaded.unit)
        else:
            if crop is None:
                picture = model.render_view(view, background)
            else:
                picture = picture_within(model, view, crop, background)
            kept = _kept(loaded, request, view, picture, background, truth)
    wait_for(model.device)
    return kept


def _kept(
    loaded: Loaded, request: Request, view: View, picture: Picture, background: Tensor, truth: Truth | None
) -> Arrays:
    if truth is not None and (request.output == FLAWS or (request.output == RGB.name and request.overlay)):
        found = truth(view, picture.rgb, background)
    else:
        found = None
    if request.output == FLAWS:
        return kept_outputs(picture, [RGB if found is None else ERROR], loaded.unit, found)
    if found is not None:
        picture = replace(picture, rgb=torch.lerp(picture.rgb, found, request.overlay))
    known = {output.name: output for output in (*FIXED, *loaded.model.outputs)} | {DEPTH: MEDIAN_DEPTH}
    return kept_outputs(picture, [known.get(request.output, RGB)], loaded.unit)


def _appearance(loaded: Loaded, image: int | None) -> AbstractContextManager[None]:
    appearance = loaded.model.appearance
    if appearance is None:
        return nullcontext()
    own = appearance.of_images().detach()
    vector = own.mean(0) if image is None or not 0 <= image < len(own) else own[image]
    return shown_appearance(loaded.model, appearance.of_any_view(vector))  # a piece does not know its position


def number_kept(kept: Arrays) -> str | None:
    """Return the name of the number in the arrays `kept`; None if the output is not a number."""
    return next((name for name, values in kept.items() if is_number(values)), None)


def colored(kept: Arrays, ends: tuple[float, float] | None = None) -> np.ndarray:
    """Return the picture (H, W, 3) uint8 of arrays `kept`, numbers between `ends`, or their own if None."""
    name = number_kept(kept)
    if name is None:
        return shown_output(kept, next(iter(kept)), {})
    return shown_output(kept, name, {name: distance_range([kept], name) if ends is None else ends})
