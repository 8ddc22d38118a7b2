"""The views that each path of `ns-render` renders."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.cameras.camera_path import read_camera_path, read_transforms
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.poses import looked_at
from nerfloom.cli.render_flags import (
    CameraPathFlags,
    DatasetFlags,
    FramesFlags,
    InterpolateFlags,
    OrbitFlags,
    SpiralFlags,
    TimeFlags,
)
from nerfloom.data.dataset import Dataset
from nerfloom.data.image_files import reduce_image
from nerfloom.data.parsed_scene import ParsedScene
from nerfloom.data.pixels.batch import composite
from nerfloom.evaluation.paths import (
    arc_of,
    around,
    focus_distance,
    interpolate,
    middle_pose,
    orbit,
    replace_poses,
    spiral,
    stretches,
)
from nerfloom.scene.folded_poses import in_order
from nerfloom.training.loaded import Loaded


@dataclass(frozen=True)
class Views:
    """F views to render."""

    cameras: Cameras
    """F cameras at their final size, on the model's device."""
    times: Tensor | None = None
    """(F,) time of each; None for a static scene."""
    fps: float = 16.0
    """Frames per second of a video."""
    names: tuple[str, ...] | None = None
    """F names of image files without extension; None for numbers."""
    truth: Callable[[int], Tensor] | None = None
    """Function from an index to the true image (H, W, 3) in [0, 1]; None if it is unknown."""


def camera_path_views(flags: CameraPathFlags, loaded: Loaded) -> Views:
    """Return the views of a camera path file; this needs no data.

    Args:
        flags: flags of the path.
        loaded: what is rendered.

    Raises:
        DataError: if the file cannot be read.
        ConfigError: if the run is in normalised device coordinates.
    """
    if loaded.model.scene.warped:
        raise ConfigError("ns-render camera-path: this run sees only what its cameras saw (--ndc); take spiral")
    path = read_camera_path(flags.camera_path_filename)
    if flags.dataparser_transforms is not None:
        path = replace(path, placement=read_transforms(flags.dataparser_transforms))
    path = path.placed(loaded.input_placement)
    if path.has_crop:
        say(f"{flags.camera_path_filename}: its crop box is not applied")
    times = None
    if loaded.model.scene.moving:
        times = torch.linspace(0, 1, len(path)) if path.times is None else path.times
    cameras = path.cameras().scaled(1 / flags.outputs.downscale_factor).to(loaded.model.device)
    return Views(cameras, times, path.fps if flags.fps is None else flags.fps)


def path_views(
    flags: FramesFlags, loaded: Loaded, parsed: ParsedScene, cameras: Cameras, moment: float | None = None
) -> Views:
    """Return the views of cameras that follow from the data's.

    Args:
        flags: flags of the path.
        loaded: what is rendered.
        parsed: the data.
        cameras: F cameras, as large as the data's files.
        moment: time of all frames of a moving scene; None if it runs from 0 to 1.
    """
    times, count = None, len(cameras)
    if loaded.model.scene.moving:
        times = torch.linspace(0, 1, count) if moment is None else torch.full((count,), moment)
    cameras = cameras.scaled(1 / (flags.outputs.downscale_factor * parsed.downscale_factor))
    return Views(cameras.to(loaded.model.device), times, flags.fps)


def _interpolated(flags: InterpolateFlags, loaded: Loaded) -> Views:
    parsed = loaded.parsed("train")
    return path_views(flags, loaded, parsed, walk_past(parsed, flags.num_frames))


def _one_camera(flags: TimeFlags, loaded: Loaded) -> Views:
    parsed = loaded.parsed(flags.split)
    if not loaded.model.scene.moving:
        raise ConfigError("ns-render time: the photographs of this run have no times")
    if not 0 <= flags.camera_index < len(parsed.cameras):
        last = len(parsed.cameras) - 1
        raise FlagError(f"--camera-index is {flags.camera_index}; '{flags.split}' has cameras 0 to {last}")
    cameras = parsed.cameras[torch.full((flags.num_frames,), flags.camera_index)]
    return path_views(flags, loaded, parsed, cameras)


def _circle(flags: OrbitFlags, loaded: Loaded) -> Views:
    scene = loaded.model.scene
    if loaded.source is None:
        middle, factor = scene.box.mean(0).cpu(), flags.outputs.downscale_factor
        cameras = orbit(around(scene), middle, flags.num_frames).scaled(1 / factor)
        return Views(cameras.to(loaded.model.device), None, flags.fps)
    parsed = loaded.parsed("train")
    if scene.warped:
        raise ConfigError("ns-render orbit: this run knows what its cameras look at from the front only (--ndc)")
    # An object's centre is the box's; a capture's is the point that its cameras look at.
    target = looked_at(parsed.cameras.camera_to_worlds) if scene.unbounded else None
    middle = scene.box.mean(0).cpu() if target is None else target.float()
    # Around an object all directions are rendered; a capture is known only in the directions of its photographs.
    arc = arc_of(parsed.cameras, middle) if scene.unbounded and not flags.full_circle else None
    if arc is not None:
        swept = f"the photographs go around {math.degrees(arc.width):.0f} of 360 degrees"
        say(f"{swept}: the path swings there and back (--full-circle True goes all around)")
    if flags.time is not None and not scene.moving:
        raise ConfigError(f"--time {flags.time:g}: the photographs of this run have no times")
    if flags.time is not None and not 0 <= flags.time <= 1:
        raise FlagError(f"--time is {flags.time:g}; it must be from 0 to 1")
    cameras = orbit(parsed.cameras, middle, flags.num_frames, arc)
    return path_views(flags, loaded, parsed, cameras, flags.time)


def walk_past(parsed: ParsedScene, num_frames: int) -> Cameras:
    """Return a smooth path past the cameras in the order of their images' names, and report jumps.

    Args:
        parsed: the photographs.
        num_frames: number of cameras on the path.
    """
    order = in_order([str(file) for file in parsed.image_paths])  # data formats sort 10.jpg before 2.jpg
    cameras = parsed.cameras[torch.tensor(order)]
    parts = stretches(cameras)
    if left := len(cameras) - sum(map(len, parts)):
        say(f"the path leaves out {left} of {len(cameras)} photographs, which are far from those before and after them")
    if jumps := len(parts) - 1:
        times = "once" if jumps == 1 else f"{jumps} times"
        say(f"the photographs' walk jumps {times}, and so does the path, like a cut in a film")
    return interpolate(cameras, num_frames)


def _spiral(flags: SpiralFlags, loaded: Loaded) -> Views:
    model, parsed = loaded.model, loaded.parsed("train")
    middle = replace_poses(parsed.cameras, middle_pose(parsed.cameras)[None]).scaled(1 / parsed.downscale_factor)
    focus = focus_distance(model, middle.to(model.device), model.background)
    return path_views(flags, loaded, parsed, spiral(parsed.cameras, flags.num_frames, focus, flags.radius))


def dataset_views(flags: DatasetFlags, loaded: Loaded) -> Views:
    """Return the views of a split, with their true images.

    Args:
        flags: flags of the path.
        loaded: what is rendered.

    Raises:
        DataError: if the data cannot be read.
    """
    dataset = loaded.dataset(flags.split)
    background, factor = loaded.model.background, flags.outputs.downscale_factor

    def truth(index: int) -> Tensor:
        return composite(_reduced(dataset, index, factor).float() / 255, background)

    cameras = dataset.cameras if factor == 1 else dataset.cameras.scaled(1 / factor)
    return Views(cameras, dataset.times, flags.fps, _stems(dataset.names), truth)


def _reduced(dataset: Dataset, index: int, factor: int) -> Tensor:
    """Return an image (H, W, 3 or 4) uint8 reduced by an integer factor."""
    image = dataset.image(index)
    if factor == 1:
        return image
    pixels = image.cpu().numpy()
    opaque = np.full((*pixels.shape[:2], 1), 255, np.uint8)
    reduced = reduce_image(
        np.concatenate([pixels[..., :3], pixels[..., 3:] if pixels.shape[2] == 4 else opaque], -1), factor
    )
    return torch.from_numpy(reduced[..., : pixels.shape[2]].copy()).to(image.device)


def _stems(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of images without extension, numbered where they are not unique."""
    stems = [Path(name).stem for name in names]
    if max(Counter(stems).values()) == 1:
        return tuple(stems)
    return tuple(f"{index:04d}_{stem}" for index, stem in enumerate(stems))


VIEWS: dict[str, Callable[[Any, Loaded], Views]] = {
    "camera-path": camera_path_views,
    "interpolate": _interpolated,
    "spiral": _spiral,
    "orbit": _circle,
    "time": _one_camera,
    "dataset": dataset_views,
}
"""The function of each path of `render_flags.PATHS`."""
