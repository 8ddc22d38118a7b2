"""Points that another program exported beside its cameras."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.console import say
from nerfloom.base.errors import DataError
from nerfloom.base.evenly_spaced import evenly_spaced
from nerfloom.data.ply import read_columns, read_header, vertices
from nerfloom.geometry.local_origin import local_origin, rounding
from nerfloom.processing.capture import Capture, check_points

COLORS = ("red", "green", "blue")
"""Properties of coloured vertices."""
TO_BYTES = {"f4": 255.0, "f8": 255.0, "u2": 255 / 65535}
"""Type of a colour -> factor to the range from 0 to 255; 1 for others. Colours that are not whole are from 0 to 1."""
GREY = 128
"""Colour of points without colour."""
MAX_POINTS = 2_000_000
"""Maximum number of points that are taken. A dense cloud may have a hundred million, and points are written as text."""


def with_points(capture: Capture, file: Path | None) -> Capture:
    """Return a capture with the points of a PLY file in place of its own: at most `MAX_POINTS`, evenly spaced in it.

    Args:
        file: the PLY file, or a folder of several, in the frame of the program; None leaves the capture as it is.

    Raises:
        DataError: if a file cannot be read, has no finite vertices, or most of them are far from the cameras.
    """
    if file is None:
        return capture
    files = sorted(file.glob("*.ply")) if file.is_dir() else [file]
    if not files:
        raise DataError(f"{file} has no PLY file")
    read = [_colored(each, max(MAX_POINTS // len(files), 1)) for each in files]
    points, colors = (np.concatenate(part) for part in zip(*read, strict=True))
    made = replace(capture, points=points, colors=colors)
    check_points(made, file)
    return made


def _colored(file: Path, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points (K, 3) float64 of a file and their colours (K, 3) uint8, at most `most`, evenly spaced in it."""
    element = vertices(file, read_header(file))
    colored = set(COLORS) <= set(element.names)
    chosen = evenly_spaced(element.count, most).numpy()
    columns = [values[chosen] for values in read_columns(file, element, [*"xyz", *(COLORS if colored else ())])]
    if len(chosen) < element.count:
        say(f"{file}: {len(chosen):,} of {element.count:,} points are taken, evenly spaced in the file")
    points = np.stack(columns[:3], axis=1).astype(np.float64)
    kind = dict(element.columns)["red"] if colored else ""
    colors = np.stack(columns[3:], axis=1) * TO_BYTES.get(kind, 1.0) if colored else np.full(points.shape, GREY)
    finite = np.isfinite(points).all(axis=1)
    if not finite.any():
        raise DataError(f"{file} has no point that is finite; leave it out, or export it again")
    if not finite.all():
        say(f"{file}: {int((~finite).sum()):,} of {len(points):,} points are not finite and left out")
    if dict(element.columns)["x"] == "f4" and element.order != "ascii":
        _report_rounding(file, torch.from_numpy(points[finite]))
    return points[finite], np.nan_to_num(colors[finite].astype(np.float64)).clip(0, 255).round().astype(np.uint8)


def _report_rounding(file: Path, points: Tensor) -> None:
    """Report if a file has the positions of `points` (K, 3) in float32, and float32 is too coarse for them."""
    if local_origin(points) is not None:
        say(
            f"{file}: so far from the origin, single precision has rounded its coordinates by up to "
            f"{rounding(points):.2g}; export it in double precision, if the program can"
        )
