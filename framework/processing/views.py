"""Images of one lens resampled to those of another: views cut out of panoramas, and lenses that are straightened."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from nerfloom.base.errors import DataError
from nerfloom.processing import aria_lens, metashape_lens
from nerfloom.processing.transforms import Lens

BAND = 2**19
"""Number of pixels of a view that are computed at once, which bounds the memory."""
MIN_SEEN = 0.25
"""Views with a smaller share of pixels inside the image are left out."""
MIN_SIDE, MAX_SIDE = 16, 16384
"""Minimum and maximum side of a view, pixels."""
_MODELS = {
    "OPENCV": ("opencv", ("k1", "k2", "p1", "p2", "k3", "", "", "", "k4")),
    "OPENCV_FISHEYE": ("fisheye", ("k1", "k2", "k3", "k4")),
    "EQUIRECTANGULAR": ("equirectangular", ()),
}
"""Model of a lens -> projection of `lenses.LENSES`, and the names of its coefficients in their order; "" for none."""
_PROJECTIONS: dict[str, Callable[[np.ndarray, dict[str, float]], tuple[np.ndarray, np.ndarray, np.ndarray]]] = {
    aria_lens.MODEL: aria_lens.project,
    metashape_lens.FRAME: partial(metashape_lens.project, fisheye=False),
    metashape_lens.FISHEYE: partial(metashape_lens.project, fisheye=True),
}
"""Model that transforms.json cannot express -> its projection."""


@dataclass(frozen=True)
class Views:
    """Directions and angle of the views that are cut out of each image."""

    count: int
    """Number of views around the horizon, at equal angles; the first looks ahead."""
    angle: float
    """Angle of view, horizontal and vertical, degrees."""
    up_and_down: bool = False
    """Whether two further views look straight up and down."""

    @property
    def directions(self) -> list[tuple[float, float]]:
        """Angle to the right and angle up of each view, degrees."""
        around = [(360.0 * index / self.count, 0.0) for index in range(self.count)]
        return [*around, (0.0, 90.0), (0.0, -90.0)] if self.up_and_down else around


@dataclass(frozen=True)
class View:
    """A perspective view of an image."""

    number: int
    """Number of its direction."""
    rotation: np.ndarray
    """(3, 3) from the view's camera to the image's, OpenGL axes."""
    pixels: np.ndarray
    """(S, S, C) uint8."""
    seen: np.ndarray
    """(S, S) bool: pixels that lie inside the image."""


def turned(right: float, up: float) -> np.ndarray:
    """Return the rotation (3, 3) from a view, `right` and `up` degrees off, to its image's camera, OpenGL axes."""
    a, b = math.radians(right), math.radians(up)
    around = np.array([[math.cos(a), 0, -math.sin(a)], [0, 1, 0], [math.sin(a), 0, math.cos(a)]])
    tilt = np.array([[1, 0, 0], [0, math.cos(b), -math.sin(b)], [0, math.sin(b), math.cos(b)]])
    return around @ tilt


def view_lens(lens: Lens, angle: float) -> Lens:
    """Return the lens of views of `angle` degrees of an image of `lens`, with the same size of pixels at the centre.

    Raises:
        DataError: if views would be too large.
    """
    density = lens.values["fl_x"] / (math.pi if lens.model == "EQUIRECTANGULAR" else 1)  # pixels per radian
    half = math.tan(math.radians(angle) / 2)
    side = max(2 * round(density * half), MIN_SIDE)
    if side > MAX_SIDE:
        raise DataError(f"views of {angle:g} degrees would have {side:.3g} pixels a side; use a smaller --view-angle")
    focal = side / 2 / half
    return Lens("OPENCV", {"w": side, "h": side, "fl_x": focal, "fl_y": focal, "cx": side / 2, "cy": side / 2})


def cut(image: np.ndarray, lens: Lens, views: Views) -> Iterator[View]:
    """Yield the views of an image that show enough of it, by linear interpolation between its pixels.

    Args:
        image: (H, W, C) uint8.
        lens: lens of the image, of a model in OPENCV, OPENCV_FISHEYE, EQUIRECTANGULAR, FISHEYE624 and Metashape's.
        views: directions and angle.
    """
    target = view_lens(lens, views.angle)
    for number, direction in enumerate(views.directions):
        rotation = turned(*direction)
        pixels, seen = resampled(image, lens, target, rotation)
        if seen.mean() >= MIN_SEEN:
            yield View(number, rotation, pixels, seen)


def resampled(image: np.ndarray, lens: Lens, target: Lens, rotation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return what a camera of another lens and direction shows, by linear interpolation between an image's pixels.

    Args:
        image: (H, W, C) uint8.
        lens: lens of the image.
        target: lens of the result, of a model of transforms.json.
        rotation: (3, 3) from the result's camera to the image's, OpenGL axes.

    Returns:
        Pixels (target's h, w, C) uint8, and (h, w) bool, whether they lie inside the image.
    """
    width, height = int(target.values["w"]), int(target.values["h"])
    pixels, seen = np.empty((height, width, image.shape[2]), np.uint8), np.empty((height, width), bool)
    step = max(BAND // width, 1)
    for start in range(0, height, step):
        rows = slice(start, min(start + step, height))
        columns_at, rows_at, seen[rows] = positions(lens, target, rotation, rows)
        pixels[rows] = interpolated(image, columns_at, rows_at, wraps=lens.model == "EQUIRECTANGULAR")
    return pixels, seen


def positions(lens: Lens, view: Lens, rotation: np.ndarray, rows: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the positions in an image of the pixels of a view.

    Args:
        lens: lens of the image.
        view: lens of the view, of a model of transforms.json.
        rotation: (3, 3) from the view's camera to the image's, OpenGL axes.
        rows: R rows of the view.

    Returns:
        Columns and rows (R, W) in the image, float64, pixels, where the first pixel's centre is at 0.5; and (R, W)
        bool, whether the position is inside the image.
    """
    down, across = np.mgrid[rows, : int(view.values["w"])] + 0.5
    local, shown = _directions(view, across.reshape(-1), down.reshape(-1))
    x, y, visible = _projected(lens, local @ rotation.T)
    unit = math.pi if lens.model == "EQUIRECTANGULAR" else 1.0  # the focal length of a panorama is half its width
    columns = x.reshape(across.shape) * (lens.values["fl_x"] / unit) + lens.values["cx"]
    lines = y.reshape(across.shape) * (lens.values["fl_y"] / unit) + lens.values["cy"]
    inside = (columns >= 0) & (columns <= lens.values["w"]) & (lines >= 0) & (lines <= lens.values["h"])
    return columns, lines, inside & (visible & shown).reshape(across.shape)


def _directions(lens: Lens, columns: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the directions (N, 3), OpenGL axes, of positions (N,) in an image, and (N,) bool, whether there is one."""
    import torch

    from nerfloom.geometry.lenses import unproject

    model, distortion = _torch_lens(lens)
    unit = math.pi if lens.model == "EQUIRECTANGULAR" else 1.0
    x = torch.from_numpy((columns - lens.values["cx"]) / lens.values["fl_x"] * unit)
    y = torch.from_numpy((rows - lens.values["cy"]) / lens.values["fl_y"] * unit)
    rays = unproject(model, x, y, distortion)
    return rays.directions.numpy(), rays.valid.numpy()


def _projected(lens: Lens, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where a lens shows directions (N, 3): x and y (N,) of its image plane, y down, and whether it does."""
    if lens.model in _PROJECTIONS:
        return _PROJECTIONS[lens.model](directions, lens.values)
    import torch

    from nerfloom.geometry.lenses import project

    model, distortion = _torch_lens(lens)
    x, y, visible = project(model, torch.from_numpy(directions), distortion)
    return x.numpy(), y.numpy(), visible.numpy()


def _torch_lens(lens: Lens) -> tuple[str, Any]:
    """Return the projection of a lens of transforms.json, a key of `lenses.LENSES`, and its `Distortion` or None."""
    import torch

    from nerfloom.geometry.lenses import DISTORTED, Distortion

    model, names = _MODELS[lens.model]
    coefficients = [lens.values.get(name, 0.0) for name in names]
    if model == "opencv" and not any(coefficients):
        model = "pinhole"
    if model not in DISTORTED:
        return model, None
    return model, Distortion.of(model, torch.tensor([coefficients], dtype=torch.float64))


def interpolated(image: np.ndarray, columns: np.ndarray, rows: np.ndarray, wraps: bool) -> np.ndarray:
    """Return an image's colours at positions, by linear interpolation.

    Args:
        image: (H, W, C) uint8.
        columns, rows: (...) positions, pixels; the first pixel's centre is at 0.5.
        wraps: whether the first column follows the last, as in a panorama; otherwise the outermost pixels continue.

    Returns:
        (..., C) uint8.
    """
    height, width = image.shape[:2]
    across, down = columns - 0.5, np.clip(rows - 0.5, 0, height - 1)
    if not wraps:
        across = np.clip(across, 0, width - 1)
    left, top = np.floor(across).astype(np.int64), np.floor(down).astype(np.int64)
    share_x = (across - left)[..., None].astype(np.float32)
    share_y = (down - top)[..., None].astype(np.float32)
    bottom = np.minimum(top + 1, height - 1)
    right = (left + 1) % width if wraps else np.minimum(left + 1, width - 1)
    left = left % width
    upper = image[top, left] * (1 - share_x) + image[top, right] * share_x
    lower = image[bottom, left] * (1 - share_x) + image[bottom, right] * share_x
    return (upper * (1 - share_y) + lower * share_y).round().astype(np.uint8)
