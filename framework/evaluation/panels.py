"""Comparison images: a row of labelled panels with colour bars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from nerfloom.evaluation.images import ERROR_AT_WHITE, heat, to_uint8
from nerfloom.rendering.outputs import ACCUMULATION, MEDIAN_DEPTH, Output
from nerfloom.rendering.rendered import Picture

MIN_WIDTH = 160
"""Minimum width of a panel, pixels; smaller images are enlarged by a whole number."""
TEXT_SHARE, MIN_TEXT = 24, 12
"""Ratio of a panel's width to the height of text, and the minimum height of text, pixels."""
INK, PAPER = (20, 20, 20), (255, 255, 255)
"""Colours of text and background, 8-bit RGB."""


@dataclass(frozen=True)
class Panel:
    """A labelled image, with an optional colour bar."""

    label: str
    """Text above the image."""
    image: Tensor
    """(H, W, 3) colours in [0, 1]."""
    ends: tuple[str, str] | None = None
    """Texts at the two ends of the colour bar; None for no bar."""
    bar: Tensor | None = None
    """(N, 3) colours of the bar from left to right; None for no bar."""


def view_panels(prediction: Tensor, target: Tensor, picture: Picture) -> list[Panel]:
    """Return panels of `target`, `prediction`, error, depth, opacity and further outputs of a `picture`."""
    ramp = torch.linspace(0, 1, 256)
    error = (prediction - target).abs().mean(-1) / ERROR_AT_WHITE
    panels = [
        Panel("photograph", target),
        Panel("render", prediction),
        Panel("error", heat(error), ("0", f"{ERROR_AT_WHITE:g} or more"), heat(ramp[None])[0]),
    ]
    for output in (MEDIAN_DEPTH, ACCUMULATION, *picture.outputs):
        image, ends = as_colors(picture, output)
        bar = None if ends is None else viridis(ramp)
        if output.kind == "opacity":
            ends, bar = ("0", "1"), ramp[:, None].expand(-1, 3)
        panels.append(Panel(output.label or output.name, image, ends, bar))
    return panels


def as_colors(picture: Picture, output: Output) -> tuple[Tensor, tuple[str, str] | None]:
    """Return an `output` of a `picture` as colours (H, W, 3), and the labels of its range, if it is a number.

    Numbers are shown where opacity is above one half, over their 2nd to 98th percentile there.
    """
    values = output.pictured(picture.of(output.name)).float()
    if output.kind not in ("distance", "scalar"):
        return (values if values.dim() == 3 else values[..., None].expand(-1, -1, 3)).clamp(0, 1), None
    solid = picture.accumulation > 0.5
    near, far = depth_range(values, solid)
    shade = viridis(((values - near) / max(far - near, 1e-9)).clamp(0, 1))
    return torch.where(solid[..., None], shade, torch.ones_like(shade)), (f"{near:.3g}", f"{far:.3g}")


def depth_range(depth: Tensor, solid: Tensor) -> tuple[float, float]:
    """Return the 2nd and 98th percentile of finite `depth` (H, W) in `solid`, if any pixel is; 0 and 0 if none."""
    values = depth[solid] if bool(solid.any()) else depth.flatten()
    values = values[torch.isfinite(values)].double().sort().values
    if not len(values):
        return 0.0, 0.0
    near, far = (float(values[round(share * (len(values) - 1))]) for share in (0.02, 0.98))
    return near, far


VIRIDIS = torch.tensor(
    [
        [0.267, 0.005, 0.329], [0.282, 0.095, 0.417], [0.279, 0.175, 0.483], [0.259, 0.252, 0.525],
        [0.230, 0.322, 0.546], [0.199, 0.388, 0.555], [0.173, 0.449, 0.558], [0.149, 0.508, 0.557],
        [0.128, 0.567, 0.551], [0.121, 0.626, 0.533], [0.158, 0.684, 0.502], [0.246, 0.739, 0.452],
        [0.369, 0.789, 0.383], [0.516, 0.831, 0.294], [0.678, 0.864, 0.190], [0.846, 0.887, 0.100],
        [0.993, 0.906, 0.144],
    ]
)  # fmt: skip
"""(17, 3) RGB in [0, 1] of matplotlib's colour map viridis at evenly spaced values."""


def viridis(values: Tensor) -> Tensor:
    """Map `values` (...) in [0, 1] to colours (..., 3), lighter for larger values; NaN counts as 0."""
    colors = VIRIDIS.to(values)
    scaled = values.nan_to_num(0.0).clamp(0, 1) * (len(colors) - 1)
    low = scaled.floor().long().clamp(max=len(colors) - 2)
    return torch.lerp(colors[low], colors[low + 1], (scaled - low)[..., None])


def composed(panels: Sequence[Panel]) -> Tensor:
    """Compose `panels` of equal size in a row, with labels and colour bars, as an image (H', W', 3) in [0, 1].

    Small panels are enlarged by a whole number, without interpolation.
    """
    height, width = panels[0].image.shape[:2]
    factor = max(-(-MIN_WIDTH // width), 1)
    height, width = height * factor, width * factor
    size = max(width // TEXT_SHARE, MIN_TEXT)
    font, gap, line = ImageFont.load_default(size), size, round(1.6 * size)
    bars = gap // 2 + size // 2 + line if any(panel.bar is not None for panel in panels) else 0
    paper = Image.new("RGB", (len(panels) * (width + gap) + gap, height + line + bars + gap // 2), PAPER)
    draw = ImageDraw.Draw(paper)
    for index, panel in enumerate(panels):
        left = gap + index * (width + gap)
        draw.text((left, line // 2), panel.label, INK, font, anchor="lm")
        picture = Image.fromarray(to_uint8(panel.image)).resize((width, height), Image.Resampling.NEAREST)
        paper.paste(picture, (left, line))
        draw.rectangle((left - 1, line - 1, left + width, line + height), outline=(190, 190, 190))
        if panel.bar is not None and panel.ends is not None:
            top = line + height + gap // 2
            bar = Image.fromarray(to_uint8(panel.bar[None])).resize((width, size // 2), Image.Resampling.BILINEAR)
            paper.paste(bar, (left, top))
            draw.rectangle((left - 1, top - 1, left + width, top + size // 2), outline=(190, 190, 190))
            middle = top + size // 2 + line // 2
            draw.text((left, middle), panel.ends[0], INK, font, anchor="lm")
            draw.text((left + width, middle), panel.ends[1], INK, font, anchor="rm")
    return torch.from_numpy(np.array(paper)).float() / 255
