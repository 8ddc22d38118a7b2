"""Flags of `ns-render`: a run, where to write, and the settings of a path. This module does not import torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerfloom.cli.run_flags import RunFlags
from nerfloom.video.settings import (
    CameraPathSettings,
    DatasetSettings,
    InterpolateSettings,
    OrbitSettings,
    SpiralSettings,
    TimeSettings,
)

USAGE = """\
usage: ns-render PATH RUN_FOLDER --output-path FILE_OR_FOLDER [flags]

paths:
  interpolate     for captures: a smooth walk past the photographs' cameras, along a short tour, and back to the first
  orbit           around what the photographs look at: a circle with the cameras' mean height and distance
  spiral          for cameras that all look the same way: a spiral in front of what they see
  time            for scenes that move: one camera, while time runs from 0 to 1
  camera-path     the cameras of a file: camera_path.json, as ns-viewer, nerfstudio's viewer and Blender write it
  dataset         the held-out photographs and their renders, one image each; or another split, --split train

  ns-render interpolate RUN_FOLDER --output-path walk.mp4
  ns-render orbit RUN_FOLDER --output-path orbit.mp4 --seconds 8 --width 1920 --height 1080

Instead of a run, pass a file of Gaussians (.ply, .spz, .sog, .splat, .ksplat) or of levels (.levels), or an
octree (.octree): orbit and camera-path need no data, others --data DIR [FORMAT [format flags]], as in

  ns-render orbit splat.ply --output-path orbit.mp4
  ns-render interpolate splat.ply --data DIR --output-path walk.mp4

ns-render PATH --help shows its flags.
"""


@dataclass(frozen=True)
class RenderFlags:
    """Flags of every path beside its settings."""

    run: RunFlags
    """The trained run, the file of Gaussians, or the octree."""
    output_path: Path | None = None
    """File to write; its extension (.mp4, .gif, .webp, .png) is the format. Without one: a folder of images. Default:
    PATH.mp4, or PATH.gif without the extra [video]; of dataset: renders."""


@dataclass(frozen=True)
class CameraPathFlags(CameraPathSettings, RenderFlags):
    """Render the cameras of a file, camera_path.json, in the format of nerfstudio's viewer."""


@dataclass(frozen=True)
class InterpolateFlags(InterpolateSettings, RenderFlags):
    """Render a smooth walk past the training cameras, along a short tour that passes each of them once."""


@dataclass(frozen=True)
class SpiralFlags(SpiralSettings, RenderFlags):
    """Render a spiral around the mean camera, for cameras that look the same way (LLFF's path)."""


@dataclass(frozen=True)
class OrbitFlags(OrbitSettings, RenderFlags):
    """Render a horizontal circle around the scene, with the mean height and distance of the training cameras.

    If the photographs of a capture leave out a sixth of the circle or more, the path swings over their part and back.
    """


@dataclass(frozen=True)
class TimeFlags(TimeSettings, RenderFlags):
    """Render the view of one camera while time runs from 0 to 1; a PNG file shows the frames side by side."""


@dataclass(frozen=True)
class DatasetFlags(DatasetSettings, RenderFlags):
    """Render each camera of a split to a folder, OUTPUT_PATH/SPLIT/OUTPUT/IMAGE.png, or to a video."""


FLAGS: dict[str, type[Any]] = {
    "camera-path": CameraPathFlags,
    "interpolate": InterpolateFlags,
    "spiral": SpiralFlags,
    "orbit": OrbitFlags,
    "time": TimeFlags,
    "dataset": DatasetFlags,
}
"""Name of a path -> its flags."""
