"""Flags of `ns-render`, in groups. This module does not import torch, so that the help is fast."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal

from nerfloom.base.config import RaysPerPixel
from nerfloom.base.errors import FlagError
from nerfloom.cli.run_flags import RunFlags

USAGE = """\
usage: ns-render PATH RUN_FOLDER --output-path FILE_OR_FOLDER [flags]

paths:
  interpolate     for captures: a smooth walk past the photographs' cameras, in the order of their names
  orbit           around what the photographs look at: a circle with the cameras' mean height and distance
  spiral          for cameras that all look the same way: a spiral in front of what they see
  time            for scenes that move: one camera, while time runs from 0 to 1
  camera-path     the cameras of a file: camera_path.json, as ns-viewer and nerfstudio's viewer write it
  dataset         the held-out photographs and their renders, one image each; or another split, --split train

  ns-render interpolate RUN_FOLDER --output-path walk.mp4

Instead of a run, pass a file of Gaussians (.ply, .spz, .sog, .splat, .ksplat) or an octree (.octree): orbit and
camera-path need no data, others --data DIR [FORMAT [format flags]], as in

  ns-render orbit splat.ply --output-path orbit.mp4
  ns-render interpolate splat.ply --data DIR --output-path walk.mp4

ns-render PATH --help shows its flags.
"""


@dataclass(frozen=True)
class ViewFlags:
    """Outputs of a view, and their colours."""

    rendered_output_names: tuple[str, ...] = ("rgb",)
    """Outputs, from left to right. rgb: colour; depth: mean distance; median_depth: distance where half of the light
    is absorbed; accumulation: opacity; outputs of the method, such as normals; with 'dataset' also gt-rgb: the
    photograph, and error: the difference from it."""
    depth_near_plane: float | None = None
    """Distance at the dark end of the depth colours, units of the input. Default: from all frames."""
    depth_far_plane: float | None = None
    """Distance at the light end, and the largest in 16-bit files. Default: from all frames."""
    downscale_factor: int = 1
    """Divide width and height by this integer."""
    rays_per_pixel: RaysPerPixel | None = None
    """Rays averaged per pixel. Default: the run's setting."""
    max_error: str | None = None
    """End rays where the rest cannot change a colour by more than this, such as 1/255. Default: 1e-4."""


@dataclass(frozen=True)
class FileFlags:
    """Output files."""

    apart: bool | None = None
    """Write each output to its own file or folder instead of side by side. Default: only for images of 'dataset'."""
    image_format: Literal["png", "jpeg"] = "png"
    """Image format in a folder."""
    depth_format: Literal["color", "png16", "npy"] = "color"
    """Depth in a folder: colours, 16-bit PNG (depth.json gives the unit) or float32 .npy; distances along the ray in
    units of the input, 0 where nothing is seen."""


@dataclass(frozen=True)
class PathFlags:
    """Flags of every path."""

    run: RunFlags
    """The trained run, the file of Gaussians, or the octree."""
    outputs: ViewFlags = field(default_factory=ViewFlags)
    """Outputs of a view, and their colours."""
    files: FileFlags = field(default_factory=FileFlags)
    """Output files."""
    output_path: Path = Path()
    """File or folder to write."""
    fps: float | None = None
    """Frames per second."""
    shows_images: ClassVar[bool] = False
    """Whether it renders the cameras of images, which have true colours; their outputs go to folders of their own."""
    png_is_strip: ClassVar[bool] = False
    """Whether a PNG file shows the frames side by side; if not, it is an animation."""

    def check(self) -> None:
        """Refuse flags that contradict each other or are out of range.

        Raises:
            FlagError: with what is wrong.
        """
        shown, outputs = self.outputs, self.outputs.rendered_output_names
        if (self.fps is not None and not 0 < self.fps <= 1000) or shown.downscale_factor < 1:
            raise FlagError("--downscale-factor must be at least 1, --fps more than 0 and at most 1000")
        if not outputs or len(set(outputs)) < len(outputs):
            raise FlagError(f"--rendered-output-names {' '.join(outputs)}: name at least one output, and each once")
        if not self.shows_images and (unknown := {"error", "gt-rgb"} & set(outputs)):
            raise FlagError(f"--rendered-output-names {min(unknown)}: only 'ns-render dataset' has true images")
        near, far = shown.depth_near_plane, shown.depth_far_plane
        if not 0 <= (near or 0) < (1e30 if far is None else far):
            raise FlagError(f"--depth-near-plane {near} and --depth-far-plane {far}: near must be from 0 to far")
        if self.files.depth_format != "color":
            if not {"depth", "median_depth"} & set(outputs):
                raise FlagError(f"--depth-format {self.files.depth_format}: add depth to --rendered-output-names")
            if self.output_path.suffix:
                raise FlagError(
                    f"--depth-format {self.files.depth_format} needs a folder: --output-path without an extension, "
                    f"such as {self.output_path.with_suffix('')}"
                )

    @property
    def folder_or_file(self) -> Path:
        """Folder or file that is written."""
        return self.output_path


@dataclass(frozen=True)
class FramesFlags(PathFlags):
    """Flags of paths with a chosen number of frames."""

    num_frames: int = 48
    """Number of frames."""
    fps: float = 16.0
    """Frames per second."""

    def check(self) -> None:
        super().check()
        if self.num_frames < 1:
            raise FlagError(f"--num-frames is {self.num_frames}; it must be at least 1")


@dataclass(frozen=True)
class CameraPathFlags(PathFlags):
    """Render the cameras of a file, camera_path.json, in the format of nerfstudio's viewer."""

    camera_path_filename: Path = Path("camera_path.json")
    """File of the cameras, in the scene's frame as the data format places it."""
    dataparser_transforms: Path | None = None
    """dataparser_transforms.json of the path's run, if that run placed the same input differently."""
    output_path: Path = Path("camera_path.gif")
    """File to write; its extension (.mp4, .gif, .webp, .png) is the format. Without one: a folder of images."""
    fps: float | None = None
    """Frames per second. Default: the file's."""


@dataclass(frozen=True)
class InterpolateFlags(FramesFlags):
    """Render a smooth walk past the training cameras, in the order of their images' names: 2.jpg before 10.jpg."""

    output_path: Path = Path("interpolate.gif")
    """File to write; its extension (.mp4, .gif, .webp, .png) is the format. Without one: a folder of images."""
    num_frames: int = 96
    """Number of frames."""


@dataclass(frozen=True)
class SpiralFlags(FramesFlags):
    """Render a spiral around the mean camera, for cameras that look the same way (LLFF's path)."""

    output_path: Path = Path("spiral.gif")
    """File to write; its extension (.mp4, .gif, .webp, .png) is the format. Without one: a folder of images."""
    num_frames: int = 72
    """Number of frames."""
    fps: float = 24.0
    """Frames per second."""
    radius: float | None = None
    """Radius along each axis of the camera, scene units. Default: from the spread of the cameras."""

    def check(self) -> None:
        super().check()
        if self.radius is not None and not 0 < self.radius < 1e9:
            raise FlagError(f"--radius is {self.radius:g}; it must be above zero")


@dataclass(frozen=True)
class OrbitFlags(FramesFlags):
    """Render a horizontal circle around the scene, with the mean height and distance of the training cameras.

    If the photographs of a capture leave out a sixth of the circle or more, the path swings over their part and back.
    """

    output_path: Path = Path("orbit.gif")
    """File to write; its extension (.mp4, .gif, .webp, .png) is the format. Without one: a folder of images."""
    full_circle: bool = False
    """Render the full circle around a capture even where photographs are missing, instead of a swing and back."""
    time: float | None = None
    """Time of all frames of a moving scene, 0 to 1. Default: runs from 0 to 1."""


@dataclass(frozen=True)
class TimeFlags(FramesFlags):
    """Render the view of one camera while time runs from 0 to 1."""

    output_path: Path = Path("time.gif")
    """File to write: a video or animation (.mp4, .gif, .webp), or the frames side by side (.png). Without extension: a
    folder of images."""
    num_frames: int = 32
    """Number of frames."""
    png_is_strip = True
    split: Literal["train", "val", "test"] = "test"
    """Split of the camera."""
    camera_index: int = 0
    """Index of the camera in the split, from 0."""


@dataclass(frozen=True)
class DatasetFlags(PathFlags):
    """Render each camera of a split to a folder, OUTPUT_PATH/SPLIT/OUTPUT/IMAGE.png."""

    outputs: ViewFlags = field(default_factory=lambda: ViewFlags(rendered_output_names=("rgb", "gt-rgb")))
    """Outputs of a view, and their colours."""
    output_path: Path = Path("renders")
    """Folder to write to, or a video (.mp4, .gif, .webp, .png) if all images have the same size."""
    fps: float = 4.0
    """Frames per second of a video."""
    split: Literal["train", "val", "test"] = "test"
    """Split to render."""
    shows_images = True

    @property
    def folder_or_file(self) -> Path:
        return self.output_path if self.output_path.suffix else self.output_path / self.split


PATHS: dict[str, type[PathFlags]] = {
    "camera-path": CameraPathFlags,
    "interpolate": InterpolateFlags,
    "spiral": SpiralFlags,
    "orbit": OrbitFlags,
    "time": TimeFlags,
    "dataset": DatasetFlags,
}
"""Name of a path -> its flags."""
