"""Flags of `ns-render`: a run, where to write, and the settings of a path. This module does not import torch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerfloom.cli.run_flags import RunFlags
from nerfloom.video.settings import PATHS, PathSettings

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


def flags_of(settings: type[PathSettings]) -> type[Any]:
    """Return the class of the flags of a path with `settings`; the settings' docstring is the help."""
    about = settings.__doc__ or ""
    members = {"__doc__": f"Render {about[:1].lower()}{about[1:]}", "__module__": __name__}
    return dataclass(frozen=True)(type("Flags", (settings, RenderFlags), members))


FLAGS: dict[str, type[Any]] = {name: flags_of(settings) for name, settings in PATHS.items()}
"""Name of a path -> its flags."""
