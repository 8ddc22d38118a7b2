"""The views that each path renders."""

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
from nerfloom.cameras.framing import framed
from nerfloom.cameras.poses import Placement, looked_at
from nerfloom.data.dataset import Dataset
from nerfloom.data.image_files import reduce_image
from nerfloom.data.parsed_scene import ParsedScene
from nerfloom.data.pixels.batch import composite
from nerfloom.evaluation.paths import (
    Arc,
    Walk,
    arc_of,
    focus_distance,
    fractions,
    interpolate,
    middle_pose,
    orbit,
    outlooks,
    replace_poses,
    shortest_order,
    spiral,
    walk_of,
)
from nerfloom.training.loaded import Loaded
from nerfloom.video.settings import (
    CameraPathSettings,
    DatasetSettings,
    FramesSettings,
    InterpolateSettings,
    OrbitSettings,
    PathSettings,
    SpiralSettings,
    TimeSettings,
)


@dataclass(frozen=True)
class Views:
    """F views to render."""

    cameras: Cameras
    """F cameras at their final size, on the model's device."""
    times: Tensor | None = None
    """(F,) time of each; None for a static scene."""
    fps: float = 30.0
    """Frames per second of a video."""
    names: tuple[str, ...] | None = None
    """F names of image files without extension; None for numbers."""
    truth: Callable[[int], Tensor] | None = None
    """Function from an index to the true image (H, W, 3) in [0, 1]; None if it is unknown."""


def background_of(settings: PathSettings, loaded: Loaded) -> Tensor:
    """Return the colour (3,) behind the scene of `loaded` by `settings`, on the model's device.

    Raises:
        ConfigError: if the settings name no colour.
    """
    color, background = settings.color(), loaded.model.background
    return background if color is None else background.new_tensor(color)


def camera_path_views(settings: CameraPathSettings, loaded: Loaded) -> Views:
    """Return the views of a camera path file, by `settings`, for `loaded`; this needs no data.

    Raises:
        DataError: if the file cannot be read.
        ConfigError: if the run is in normalised device coordinates.
    """
    if loaded.model.scene.warped:
        raise ConfigError("ns-render camera-path: this run sees only what its cameras saw (--ndc); take spiral")
    path = read_camera_path(settings.camera_path_filename)
    if settings.dataparser_transforms is not None:
        path = replace(path, placement=read_transforms(settings.dataparser_transforms))
    if settings.frame == "exports":
        path = replace(path, placement=Placement.of(None, 1.0)).placed(loaded.placement)
    else:
        path = path.placed(loaded.input_placement)
    if path.has_crop:
        say(f"{settings.camera_path_filename}: its crop box is not applied")
    times = None
    if loaded.model.scene.moving:
        times = torch.linspace(0, 1, len(path)) if path.times is None else path.times
    cameras = path.framed(settings.width, settings.height, settings.fov).cameras()
    cameras = cameras.scaled(1 / settings.downscale_factor).to(loaded.model.device)
    return Views(cameras, times, path.fps if settings.fps is None else settings.fps)


def path_views(settings: FramesSettings, loaded: Loaded, cameras: Cameras, moment: float | None = None) -> Views:
    """Return the views of F `cameras` with the image size of `loaded`, by `settings`.

    `moment` is the time of all frames of a moving scene; None if it runs from 0 to 1.
    """
    times, count = None, len(cameras)
    if loaded.model.scene.moving:
        times = torch.linspace(0, 1, count) if moment is None else torch.full((count,), moment)
    cameras = framed(cameras, settings.width, settings.height, settings.fov).scaled(1 / settings.downscale_factor)
    return Views(cameras.to(loaded.model.device), times, settings.fps)


def learnt_cameras(parsed: ParsedScene) -> Cameras:
    """Return the cameras of a scene, `parsed`, with the size of the training images."""
    return parsed.cameras.scaled(1 / parsed.downscale_factor)


def _interpolated(settings: InterpolateSettings, loaded: Loaded) -> Views:
    cameras = learnt_cameras(loaded.parsed("train"))
    cameras = cameras[shortest_order(cameras, settings.loop)]
    walk = walk_of(cameras, settings.loop)
    for sentence in about(walk, len(cameras)):
        say(sentence)
    along = fractions(settings.count, walk.closed, settings.ease)
    return path_views(settings, loaded, interpolate(cameras, along, walk))


def about(walk: Walk, count: int) -> list[str]:
    """Return sentences about cameras, of `count`, that a `walk` leaves out, and about its jumps."""
    said = []
    if left := count - sum(map(len, walk.stretches)):
        said.append(f"the path leaves out {left} of {count} photographs, which are far from all others")
    if jumps := len(walk.stretches) - 1:
        times = "once" if jumps == 1 else f"{jumps} times"
        said.append(f"some photographs are far apart: the path jumps {times}, like a cut in a film")
    return said


def _one_camera(settings: TimeSettings, loaded: Loaded) -> Views:
    parsed = loaded.parsed(settings.split)
    if not loaded.model.scene.moving:
        raise ConfigError("ns-render time: the photographs of this run have no times")
    if not 0 <= settings.camera_index < len(parsed.cameras):
        last = len(parsed.cameras) - 1
        raise FlagError(f"--camera-index is {settings.camera_index}; '{settings.split}' has cameras 0 to {last}")
    cameras = learnt_cameras(parsed)[torch.full((settings.count,), settings.camera_index)]
    return path_views(settings, loaded, cameras)


def _circle(settings: OrbitSettings, loaded: Loaded) -> Views:
    scene = loaded.model.scene
    if scene.warped:
        raise ConfigError("ns-render orbit: this run knows what its cameras look at from the front only (--ndc)")
    if settings.time is not None and not scene.moving:
        raise ConfigError(f"--time {settings.time:g}: the photographs of this run have no times")
    if settings.time is not None and not 0 <= settings.time <= 1:
        raise FlagError(f"--time is {settings.time:g}; it must be from 0 to 1")
    cameras = outlooks(scene) if loaded.source is None else learnt_cameras(loaded.parsed("train"))
    # Around an object all directions are rendered; a capture is known only where its photographs were taken.
    is_capture = scene.unbounded and (loaded.source is not None or scene.camera_to_worlds is not None)
    # An object's centre is the box's; a capture's is the point that its cameras look at.
    target = looked_at(cameras.camera_to_worlds) if is_capture else None
    middle = scene.box.mean(0).cpu() if target is None else target.float()
    arc = arc_of(cameras, middle) if is_capture and not settings.full_circle else None
    if is_capture and not settings.full_circle:
        say(about_arc(arc))
    elif scene.unbounded and not is_capture:
        say("without photographs, the path goes all around (with --data DIR: where they were taken)")
    along, radius = fractions(settings.count, ease=settings.ease), in_scene(settings.radius, loaded)
    return path_views(settings, loaded, orbit(cameras, middle, along, arc, radius, is_capture), settings.time)


def about_arc(arc: Arc | None) -> str:
    """Return a sentence about the directions of an orbit: an `arc`, or None for all around."""
    if arc is None:
        return "the path goes all around, in each direction as high and as far as the photographs there"
    swept = f"the photographs cover {math.degrees(arc.width):.0f} of 360 degrees"
    return f"{swept}: the path swings to and fro over them (--full-circle True goes all around)"


def _spiral(settings: SpiralSettings, loaded: Loaded) -> Views:
    model, cameras = loaded.model, learnt_cameras(loaded.parsed("train"))
    middle = replace_poses(cameras, middle_pose(cameras)[None])
    focus = focus_distance(model, middle.to(model.device), model.background)
    along, radius = fractions(settings.count, ease=settings.ease), in_scene(settings.radius, loaded)
    return path_views(settings, loaded, spiral(cameras, along, focus, radius))


def in_scene(length: float | None, loaded: Loaded) -> float | None:
    """Return a `length` in the unit of exports in scene units of `loaded`; None for None."""
    return None if length is None else length / loaded.unit


def dataset_views(settings: DatasetSettings, loaded: Loaded) -> Views:
    """Return the views of the split of `loaded` that `settings` name, with their true images.

    Raises:
        DataError: if the data cannot be read.
    """
    dataset = loaded.dataset(settings.split)
    background, factor = background_of(settings, loaded), settings.downscale_factor

    def truth(index: int) -> Tensor:
        return composite(_reduced(dataset, index, factor).float() / 255, background)

    cameras = dataset.cameras if factor == 1 else dataset.cameras.scaled(1 / factor)
    return Views(cameras, dataset.times, settings.fps, _stems(dataset.names), truth)


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
"""Name of a path -> function of its settings and the run or file."""
