"""Settings of a path and its pictures. This module does not import torch, so that help is fast."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from nerfloom.base.colors import color_of
from nerfloom.base.config import RaysPerPixel
from nerfloom.base.errors import ConfigError, FlagError

MAX_FRAMES = 100_000
"""Maximum number of frames of a path."""
MAX_SIDE, MAX_IMAGE = 16_384, 2**27
"""Maximum width and height, and maximum number of pixels of an image."""
LEAST_FOV, MOST_FOV = 1.0, 170.0
"""Range of the field of view, degrees."""


@dataclass(frozen=True)
class ViewSettings:
    """Outputs of a view, and their colours."""

    rendered_output_names: tuple[str, ...] = ("rgb",)
    """Outputs, from left to right. rgb: colour; depth: mean distance; median_depth: distance where half of the light
    is absorbed; accumulation: opacity; outputs of the method, such as normals; with 'dataset' also gt-rgb: the
    photograph, and error: the difference from it."""
    depth_near_plane: float | None = None
    """Distance at the dark end of the depth colours, units of exports. Default: from all frames."""
    depth_far_plane: float | None = None
    """Distance at the light end, and the largest in 16-bit files. Default: from all frames."""
    background: str | None = None
    """Colour behind the scene: black, grey, white or #RRGGBB. Default: the run's."""
    downscale_factor: int = 1
    """Divide width and height by this integer."""
    rays_per_pixel: RaysPerPixel | None = None
    """Rays averaged per pixel. Default: the run's setting."""
    max_error: str | None = None
    """End rays where the rest cannot change a colour by more than this, such as 1/255. Default: 1e-4."""


@dataclass(frozen=True)
class FileSettings:
    """Output files."""

    apart: bool | None = None
    """Write each output to its own file or folder instead of side by side. Default: only for images of 'dataset'."""
    image_format: Literal["png", "jpeg"] = "png"
    """Image format in a folder."""
    depth_format: Literal["color", "png16", "npy"] = "color"
    """Depth in a folder: colours, 16-bit PNG (depth.json gives the unit) or float32 .npy; distances along the ray in
    units of exports, 0 where nothing is seen."""


@dataclass(frozen=True)
class PathSettings(FileSettings, ViewSettings):
    """Settings of every path."""

    fps: float | None = None
    """Frames per second. Default: the file's."""
    shows_images: ClassVar[bool] = False
    """Whether it renders the cameras of images, which have true colours; their outputs go to folders of their own."""
    png_is_strip: ClassVar[bool] = False
    """Whether a PNG file shows the frames side by side; if not, it is an animation."""

    def check(self, output: Path) -> None:
        """Refuse settings that contradict each other, or `output`, or are out of range.

        Raises:
            FlagError: with the fault.
        """
        outputs = self.rendered_output_names
        if (self.fps is not None and not 0 < self.fps <= 1000) or self.downscale_factor < 1:
            raise FlagError("--downscale-factor must be at least 1, --fps more than 0 and at most 1000")
        if not outputs or len(set(outputs)) < len(outputs):
            raise FlagError(f"--rendered-output-names {' '.join(outputs)}: name at least one output, and each once")
        if not self.shows_images and (unknown := {"error", "gt-rgb"} & set(outputs)):
            raise FlagError(f"--rendered-output-names {min(unknown)}: only 'ns-render dataset' has true images")
        near, far = self.depth_near_plane, self.depth_far_plane
        if not 0 <= (near or 0) < (1e30 if far is None else far):
            raise FlagError(f"--depth-near-plane {near} and --depth-far-plane {far}: near must be from 0 to far")
        try:
            self.color()
        except ConfigError as error:
            raise FlagError(f"--background: {error}") from error
        if self.depth_format != "color":
            if not {"depth", "median_depth"} & set(outputs):
                raise FlagError(f"--depth-format {self.depth_format}: add depth to --rendered-output-names")
            if output.suffix:
                raise FlagError(
                    f"--depth-format {self.depth_format} needs a folder: --output-path without an extension, such as "
                    f"{output.with_suffix('')}"
                )

    def color(self) -> tuple[float, float, float] | None:
        """Return the colour behind the scene, 0 to 1; None for the run's.

        Raises:
            ConfigError: if it is not a colour.
        """
        return None if self.background is None else color_of(self.background)

    def target(self, output: Path) -> Path:
        """Return the file or folder that is written for the user's `output`."""
        return output


@dataclass(frozen=True)
class LensSettings(PathSettings):
    """Settings of paths with images that can have another size."""

    width: int | None = None
    """Width of the images, pixels. Default: from the photographs, or by --height."""
    height: int | None = None
    """Height of the images, pixels. Default: likewise."""
    fov: float | None = None
    """Vertical field of view, degrees. Default: from the photographs, or the path's file."""

    def check(self, output: Path) -> None:
        super().check(output)
        for name, side in (("--width", self.width), ("--height", self.height)):
            if side is not None and not 1 <= side <= MAX_SIDE:
                raise FlagError(f"{name} is {side}; it must be from 1 to {MAX_SIDE} pixels")
        if (self.width or 1) * (self.height or 1) > MAX_IMAGE:
            raise FlagError(f"--width {self.width} --height {self.height}: the limit is {MAX_IMAGE} pixels")
        if self.fov is not None and not LEAST_FOV <= self.fov <= MOST_FOV:
            raise FlagError(f"--fov is {self.fov:g}; it must be from {LEAST_FOV:g} to {MOST_FOV:g} degrees")


@dataclass(frozen=True)
class FramesSettings(LensSettings):
    """Settings of paths with a chosen duration."""

    fps: float = 30.0
    """Frames per second."""
    seconds: float = 6.0
    """Duration, seconds."""
    num_frames: int | None = None
    """Number of frames, in place of --seconds. Default: --seconds times --fps."""

    def check(self, output: Path) -> None:
        super().check(output)
        if not 0 < self.seconds < math.inf:
            raise FlagError(f"--seconds is {self.seconds:g}; it must be above zero")
        if self.num_frames is not None and self.num_frames < 1:
            raise FlagError(f"--num-frames is {self.num_frames}; it must be at least 1")
        if self.count > MAX_FRAMES:
            flags = "--seconds and --fps make" if self.num_frames is None else "--num-frames makes"
            raise FlagError(f"{flags} {self.count:,} frames; the limit is {MAX_FRAMES:,}")

    @property
    def count(self) -> int:
        """Number of frames."""
        return max(round(self.seconds * self.fps), 1) if self.num_frames is None else self.num_frames


@dataclass(frozen=True)
class FlightSettings(FramesSettings):
    """Settings of paths of a moving camera."""

    ease: bool = False
    """Start and end at rest. Default: even speed, so that a loop has no halt."""


def check_radius(radius: float | None) -> None:
    """Refuse a `radius` that is not positive and finite; None is accepted.

    Raises:
        FlagError: with the fault.
    """
    if radius is not None and not 0 < radius < 1e9:
        raise FlagError(f"--radius is {radius:g}; it must be above zero")


@dataclass(frozen=True)
class CameraPathSettings(LensSettings):
    """The cameras of a file, camera_path.json, in the format of nerfstudio's viewer."""

    camera_path_filename: Path = Path("camera_path.json")
    """File of the cameras, of ns-viewer, of nerfstudio's viewer or its Blender add-on."""
    frame: Literal["scene", "exports"] = "scene"
    """Frame of the file's cameras. scene: the run's own, as viewers write them; exports: the frame of exported meshes
    and points, for cameras placed around these in another program."""
    dataparser_transforms: Path | None = None
    """dataparser_transforms.json of the path's run, if that run placed the same input differently."""

    def check(self, output: Path) -> None:
        super().check(output)
        if self.frame == "exports" and self.dataparser_transforms is not None:
            raise FlagError("--dataparser-transforms is the placement of a scene; --frame exports has none")


@dataclass(frozen=True)
class InterpolateSettings(FlightSettings):
    """A smooth walk past the training cameras, along a short tour that passes each of them once."""

    seconds: float = 10.0
    """Duration, seconds."""
    loop: bool = True
    """Return to the first camera."""


@dataclass(frozen=True)
class SpiralSettings(FlightSettings):
    """A spiral around the mean camera, for cameras that look the same way (LLFF's path)."""

    seconds: float = 4.0
    """Duration, seconds."""
    radius: float | None = None
    """Radius along each axis of the camera, units of exports. Default: from the spread of the cameras."""

    def check(self, output: Path) -> None:
        super().check(output)
        check_radius(self.radius)


@dataclass(frozen=True)
class OrbitSettings(FlightSettings):
    """A horizontal circle around an object, or a loop around what a capture looks at, where its photographs were taken.

    In each direction the loop is as high and as far as the photographs there. If they leave out a sixth of the circle
    or more, the path swings over their part and back.
    """

    radius: float | None = None
    """Mean radius of the path, units of exports; its height changes alike. Default: the cameras' mean distance."""
    full_circle: bool = False
    """Go around the full circle even where photographs of a capture are missing, instead of a swing and back."""
    time: float | None = None
    """Time of all frames of a moving scene, 0 to 1. Default: runs from 0 to 1."""

    def check(self, output: Path) -> None:
        super().check(output)
        check_radius(self.radius)


@dataclass(frozen=True)
class TimeSettings(FramesSettings):
    """The view of one camera while time runs from 0 to 1; a PNG file shows the frames side by side."""

    seconds: float = 4.0
    """Duration, seconds."""
    png_is_strip = True
    split: Literal["train", "val", "test"] = "test"
    """Split of the camera."""
    camera_index: int = 0
    """Index of the camera in the split, from 0."""


@dataclass(frozen=True)
class DatasetSettings(PathSettings):
    """Each camera of a split, to a folder, OUTPUT_PATH/SPLIT/OUTPUT/IMAGE.png, or to a video."""

    rendered_output_names: tuple[str, ...] = ("rgb", "gt-rgb")
    """Outputs, each in a folder: as of other paths, gt-rgb: the photograph, and error: the difference from it."""
    fps: float = 4.0
    """Frames per second of a video."""
    split: Literal["train", "val", "test"] = "test"
    """Split to render."""
    shows_images = True

    def target(self, output: Path) -> Path:
        return output if output.suffix else output / self.split


PATHS: dict[str, type[PathSettings]] = {
    "camera-path": CameraPathSettings,
    "interpolate": InterpolateSettings,
    "spiral": SpiralSettings,
    "orbit": OrbitSettings,
    "time": TimeSettings,
    "dataset": DatasetSettings,
}
"""Name of a path -> its settings."""
