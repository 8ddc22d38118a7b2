"""Outputs of a rendered view: what is kept of each frame of a video, and the pictures that are made of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.base.rendered_names import OutputName
from nerfloom.cameras.view import View
from nerfloom.evaluation.images import ERROR_AT_WHITE, heat, to_uint8
from nerfloom.evaluation.panels import depth_range, viridis
from nerfloom.model import Model
from nerfloom.rendering.rendered import Picture

NAMES: tuple[str, ...] = get_args(OutputName)
"""Names of the outputs."""
DEPTHS = ("depth", "median_depth")
"""Outputs that are distances."""
NEED_TRUTH = ("error", "gt-rgb")
"""Outputs that need the true image."""
OF_COLORS = ("rgb", *NEED_TRUTH)
"""Outputs for which the colours of a picture are enough."""
OPAQUE = 128
"""Opacity of 255 from which a pixel has a depth."""

Arrays = Mapping[str, np.ndarray]
"""What is kept of a frame: colours (H, W, 3) uint8, opacity (H, W) uint8, and distances (H, W) float32."""


def rendered_outputs(
    model: Model, view: View, background: Tensor, names: Sequence[str], unit: float, truth: Tensor | None = None
) -> Arrays:
    """Render a view, as far as its outputs need it, and return what is kept of it.

    Args:
        model: the model in evaluation mode.
        view: the view, on the model's device.
        background: (3,) colour behind the scene.
        names, unit, truth: as in `kept_outputs`.

    Raises:
        ConfigError: as `kept_outputs` does.
    """
    if set(names) <= set(OF_COLORS):
        return _kept_colors(model.render_rgb(view, background), names, truth)
    return kept_outputs(model.render_view(view, background), names, unit, truth)


def kept_outputs(picture: Picture, names: Sequence[str], unit: float, truth: Tensor | None = None) -> Arrays:
    """Return what is kept of a rendered view for its outputs.

    Args:
        picture: the rendered view.
        names: names of the outputs.
        unit: units of the input per scene unit, by which distances are multiplied.
        truth: (H, W, 3) true image in [0, 1]; None if it is unknown.

    Raises:
        ConfigError: if the method has no normals, or an output needs an unknown true image.
    """
    kept = _kept_colors(picture.rgb, names, truth)
    for name in names:
        if name in DEPTHS:
            kept[name] = (getattr(picture, name) * unit).float().cpu().numpy()
        elif name == "normals":
            if picture.normals is None:
                raise ConfigError(
                    "--rendered-output-names normals: this method has none; gaussian-splatting has, and nerfacto"
                    " trained with --predict-normals True"
                )
            kept[name] = to_uint8((picture.normals + 1) / 2)
    if set(names) & {"accumulation", "normals", *DEPTHS}:
        kept["accumulation"] = to_uint8(picture.accumulation)
    return kept


def _kept_colors(rgb: Tensor, names: Sequence[str], truth: Tensor | None) -> dict[str, np.ndarray]:
    """Return what is kept of colours (H, W, 3) for those of the outputs that need no more."""
    kept: dict[str, np.ndarray] = {}
    for name in names:
        if name in NEED_TRUTH and truth is None:
            raise ConfigError(f"--rendered-output-names {name}: only 'ns-render dataset' knows the true images")
        if name == "rgb":
            kept[name] = to_uint8(rgb)
        elif name == "error" and truth is not None:
            kept[name] = to_uint8(heat((rgb.clamp(0, 1) - truth).abs().mean(-1) / ERROR_AT_WHITE))
        elif name == "gt-rgb" and truth is not None:
            kept[name] = to_uint8(truth)
    return kept


def distance_range(frames: Iterable[Arrays], name: str) -> tuple[float, float]:
    """Return the range of distances for the colours of all frames, so that a colour means the same in each.

    It holds the range from the 2nd to the 98th percentile of the opaque pixels of every frame; 0 and 1 if there are
    none.

    Args:
        frames: what is kept of the frames.
        name: name of the output, one of `DEPTHS`.
    """
    ends = [
        depth_range(torch.from_numpy(kept[name]), torch.from_numpy(kept["accumulation"] >= OPAQUE))
        for kept in frames
        if bool((kept["accumulation"] >= OPAQUE).any())
    ]
    return (min(near for near, _ in ends), max(far for _, far in ends)) if ends else (0.0, 1.0)


def largest_distance(frames: Iterable[Arrays], name: str) -> float:
    """Return the largest finite distance of an opaque pixel in all frames; 0 if there is none.

    Args:
        frames: what is kept of the frames.
        name: name of the output, one of `DEPTHS`.
    """
    return max((float(opaque_distance(kept, name).max(initial=0)) for kept in frames), default=0.0)


def opaque_distance(kept: Arrays, name: str) -> np.ndarray:
    """Return distances (H, W) float32; 0 where less than half of the light comes from a surface.

    Args:
        kept: what is kept of the frame.
        name: name of the output, one of `DEPTHS`.
    """
    seen = (kept["accumulation"] >= OPAQUE) & np.isfinite(kept[name])
    return np.where(seen, kept[name], 0).astype(np.float32)


def shown_output(kept: Arrays, name: str, ranges: Mapping[str, tuple[float, float]]) -> np.ndarray:
    """Return the picture (H, W, 3) uint8 of an output.

    Distances are in the colours of viridis, and like normals they fade to white where nothing is seen.

    Args:
        kept: what is kept of the frame.
        name: name of the output.
        ranges: distances at the two ends of the colour map, by the output's name.
    """
    values: Any = kept[name]
    if name == "accumulation":
        return np.repeat(values[..., None], 3, axis=-1)
    if name not in ("normals", *DEPTHS):
        return values
    if name in DEPTHS:
        near, far = ranges[name]
        colors = viridis((torch.from_numpy(values) - near) / max(far - near, 1e-9))
    else:
        colors = torch.from_numpy(values).float() / 255
    opacity = torch.from_numpy(kept["accumulation"]).float()[..., None] / 255
    return to_uint8(colors * opacity + (1 - opacity))


def side_by_side(pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Return one picture (H, W', 3) of several `pictures` (H, W, 3) from left to right."""
    return np.concatenate(list(pictures), axis=1)
