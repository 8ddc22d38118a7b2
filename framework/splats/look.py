"""The settings of drawing that Gaussians were trained with. With other settings they look different.

A PLY file stores them in comments of its header. `SplatRenderMode: default` or `mip` (with opacity that makes up for
the blur of small Gaussians) is what Brush and PlayCanvas's splat-transform write and read; `mip-0.1` of NeRFICG names
the blur too; Postshot writes `antialiased 0` or `1`. `SplatBlur` and `SplatSort` are Nerfloom's own. Gaussians of a
file without them are sorted by depth, as in the code of 3D Gaussian Splatting and in gsplat.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from nerfloom.base.console import say
from nerfloom.base.errors import DataError, printable
from nerfloom.kernels.splats.project import BLUR

Sort = Literal["distance", "depth"]
"""Sort key of Gaussians: distance from the camera, or depth along its optical axis."""
MIN_BLUR, MAX_BLUR = 1e-3, 10.0
"""Range of the blur. Without blur, a flat Gaussian seen edge-on has no area."""


@dataclass(frozen=True)
class Look:
    """Settings of drawing."""

    antialiased: bool = False
    """Whether lower opacity compensates for the blur of small Gaussians."""
    blur: float = BLUR
    """Variance added in both directions on the image, pixels^2."""
    sort: Sort = "distance"
    """Sort key of Gaussians."""

    def words(self) -> str:
        """Return a description of the settings."""
        mode = "antialiased" if self.antialiased else "default render mode"
        return f"{mode}, blurred by {self.blur:g} pixels^2, sorted by {self.sort}"


OURS = Look()
"""The default settings."""
ELSEWHERE = Look(sort="depth")
"""The settings for files that state none."""


def comments(look: Look) -> list[str]:
    """Return the comments of a file that state the settings of drawing."""
    blur = [] if look.blur == BLUR else [f"SplatBlur: {look.blur:g}"]
    return [f"SplatRenderMode: {'mip' if look.antialiased else 'default'}", *blur, f"SplatSort: {look.sort}"]


def look_of(lines: Sequence[str], file: Path, otherwise: Look = ELSEWHERE) -> Look:
    """Return the settings of drawing from a file's comments. Unknown values are reported on the terminal.

    Args:
        lines: the file's comments; later ones override earlier ones.
        file: its path, for messages.
        otherwise: the settings that no comment states.

    Raises:
        DataError: if they are discs of 2D Gaussian Splatting.
    """
    look = otherwise
    for line in lines:
        key, _, value = (part.strip().lower() for part in line.replace(":", " ", 1).strip().partition(" "))
        if key == "splatrendermode":
            look = _with_mode(look, value, file)
        elif key == "antialiased" and value in ("0", "1"):
            look = replace(look, antialiased=value == "1")
        elif key == "splatblur" and (blur := _blur(value)) is not None:
            look = replace(look, blur=blur)
        elif key == "splatsort" and value in ("distance", "depth"):
            look = replace(look, sort="depth" if value == "depth" else "distance")
        elif key in ("splatblur", "splatsort"):
            say(f"warning: {file} has the comment '{printable(line)}', which is not known, and is drawn without it")
    return look


def _with_mode(look: Look, mode: str, file: Path) -> Look:
    name, dash, blur = mode.partition("-")
    if name == "2dgs":
        raise discs(file)
    if name not in ("default", "mip") or (dash and _blur(blur) is None):
        say(f"warning: {file} is for the render mode '{printable(mode)}', which is not known: drawn as 'default'")
        return replace(look, antialiased=False)
    return replace(look, antialiased=name == "mip", blur=_blur(blur) or look.blur)


def discs(file: Path) -> DataError:
    """Return the error of a file with discs instead of Gaussians.

    Args:
        file: its path.
    """
    return DataError(
        f"{file} has the discs of 2D Gaussian Splatting, which are not drawn here; name a file of 3D Gaussians,"
        " or train gaussian-splatting on the photographs"
    )


def _blur(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) and MIN_BLUR <= value <= MAX_BLUR else None
