"""Outputs of a rendered view: arrays kept for each frame of a video, and pictures made of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.cameras.view import View
from nerfloom.evaluation.images import ERROR_AT_WHITE, heat, to_uint8
from nerfloom.evaluation.panels import depth_range, viridis
from nerfloom.renderable import Renderable
from nerfloom.rendering.outputs import ACCUMULATION, FIXED, RGB, Output
from nerfloom.rendering.rendered import Picture

ERROR, PHOTOGRAPH = Output("error", "color"), Output("gt-rgb", "color", "photograph")
"""Outputs that need the true image: the difference from it, and the image itself."""
OPAQUE = 128
"""Minimum opacity, of 255, for a pixel to have a depth."""

Arrays = Mapping[str, np.ndarray]
"""Arrays of a frame by name: uint8 (H, W) or (H, W, 3), shown unchanged, or float32 numbers (H, W)."""


def chosen_outputs(model: Renderable, names: Sequence[str]) -> list[Output]:
    """Return the outputs of these `names`; `model` declares its own.

    Raises:
        ConfigError: if the model has no output of that name.
    """
    known = {output.name: output for output in (*FIXED, *model.outputs, ERROR, PHOTOGRAPH)}
    for name in names:
        if name not in known:
            hint = "; nerfacto has them with --predict-normals True" if name == "normals" else ""
            raise ConfigError(
                f"--rendered-output-names {name}: this run has no such output; it has {', '.join(known)}{hint}"
            )
    return [known[name] for name in names]


def rendered_outputs(
    model: Renderable,
    view: View,
    background: Tensor,
    outputs: Sequence[Output],
    unit: float,
    truth: Tensor | None = None,
) -> Arrays:
    """Render the parts of a view needed for some outputs, and return the arrays for these outputs.

    Args:
        model: the model in evaluation mode.
        view: the view, on the model's device.
        background: (3,) colour behind the scene.
        outputs, unit, truth: as in `kept_outputs`.

    Raises:
        ConfigError: see `kept_outputs`.
    """
    if all(output in (RGB, ERROR, PHOTOGRAPH) for output in outputs):
        return {output.name: _colors(output, model.render_rgb(view, background), truth) for output in outputs}
    return kept_outputs(model.render_view(view, background), outputs, unit, truth)


def kept_outputs(picture: Picture, outputs: Sequence[Output], unit: float, truth: Tensor | None = None) -> Arrays:
    """Return the arrays of a rendered view for some outputs.

    Args:
        picture: the rendered view.
        outputs: outputs to show.
        unit: units of the input per scene unit; distances are multiplied by it.
        truth: (H, W, 3) true image in [0, 1]; None if it is unknown.

    Raises:
        ConfigError: if an output needs an unknown true image.
    """
    kept: dict[str, np.ndarray] = {}
    for output in outputs:
        if output in (RGB, ERROR, PHOTOGRAPH):
            kept[output.name] = _colors(output, picture.rgb, truth)
            continue
        values = output.pictured(picture.of(output.name))
        if output.kind in ("distance", "scalar"):
            factor = unit if output.kind == "distance" else 1.0
            kept[output.name] = (values * factor).float().cpu().numpy()
        else:
            opacity = picture.accumulation[..., None]  # directions fade where nothing is visible
            kept[output.name] = to_uint8(values * opacity + (1 - opacity) if output.kind == "direction" else values)
    if any(values.dtype == np.float32 for values in kept.values()):
        kept[ACCUMULATION.name] = to_uint8(picture.accumulation)
    return kept


def _colors(output: Output, rgb: Tensor, truth: Tensor | None) -> np.ndarray:
    """Return the picture (H, W, 3) or (H, W) uint8 of an output that depends on colours (H, W, 3) only."""
    if output == RGB:
        return to_uint8(rgb)
    if truth is None:
        raise ConfigError(f"--rendered-output-names {output.name}: only 'ns-render dataset' has true images")
    return to_uint8(heat((rgb.clamp(0, 1) - truth).abs().mean(-1) / ERROR_AT_WHITE) if output == ERROR else truth)


def distance_range(frames: Iterable[Arrays], name: str) -> tuple[float, float]:
    """Return the range of colours of an output `name`, a number, in all `frames`, so that they mean the same in each.

    It covers the 2nd to the 98th percentile of the opaque pixels of every frame; 0 and 1 if there are none.
    """
    ends = [
        depth_range(torch.from_numpy(kept[name]), torch.from_numpy(kept["accumulation"] >= OPAQUE))
        for kept in frames
        if bool((kept["accumulation"] >= OPAQUE).any())
    ]
    return (min(near for near, _ in ends), max(far for _, far in ends)) if ends else (0.0, 1.0)


def largest_distance(frames: Iterable[Arrays], name: str) -> float:
    """Return the largest finite output `name` of opaque pixels in all `frames`; 0 if there are none."""
    return max((float(opaque_distance(kept, name).max(initial=0)) for kept in frames), default=0.0)


def opaque_distance(kept: Arrays, name: str) -> np.ndarray:
    """Return the output `name` (H, W) float32 in `kept`; 0 where less than half of the light comes from a surface."""
    seen = (kept["accumulation"] >= OPAQUE) & np.isfinite(kept[name])
    return np.where(seen, kept[name], 0).astype(np.float32)


def is_number(values: np.ndarray) -> bool:
    """Return whether `values` are numbers, which need a range of colours."""
    return values.dtype == np.float32


def shown_output(kept: Arrays, name: str, ranges: Mapping[str, tuple[float, float]]) -> np.ndarray:
    """Return the picture (H, W, 3) uint8 of an output.

    Numbers use the colour map viridis, and fade to white where nothing is visible.

    Args:
        kept: arrays of the frame.
        name: name of the output.
        ranges: numbers at the two ends of the colour map, by the output's name.
    """
    values: Any = kept[name]
    if not is_number(values):
        return values if values.ndim == 3 else np.repeat(values[..., None], 3, axis=-1)
    near, far = ranges[name]
    colors = viridis((torch.from_numpy(values) - near) / max(far - near, 1e-9))
    opacity = torch.from_numpy(kept[ACCUMULATION.name]).float()[..., None] / 255
    return to_uint8(colors * opacity + (1 - opacity))


def side_by_side(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Join `pictures` (H, W, 3) from left to right into one picture (H, W', 3); a single one is not copied."""
    return pictures[0] if len(pictures) == 1 else np.concatenate(list(pictures), axis=1)
