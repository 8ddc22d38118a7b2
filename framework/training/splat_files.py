"""Loading of files of Gaussians, with or without their photographs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nerfloom.base.console import say
from nerfloom.base.device import choose_device
from nerfloom.base.errors import ConfigError, DataError
from nerfloom.base.machine_config import MachineConfig
from nerfloom.cameras.camera_path import CameraPath
from nerfloom.cameras.kept_cameras import read_cameras
from nerfloom.cameras.poses import UP, Placement
from nerfloom.cameras.scale import Scale, read_scale
from nerfloom.data.offsets import offset_file, read_offset
from nerfloom.data.parsed_scene import ParsedScene
from nerfloom.data.scene import Scene
from nerfloom.geometry.local_origin import local_origin, rounding
from nerfloom.splats.drawn import DrawnGaussians
from nerfloom.splats.files import read_gaussians
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.placement import Axis, direction_of, placed_gaussians
from nerfloom.splats.transform import transformed
from nerfloom.training.file_data import DataFormat, scene_of, source_of
from nerfloom.training.loaded import Loaded
from nerfloom.training.run import Run

METHOD = "gaussian-splatting"
"""Method of such files, whichever program wrote them."""


def load_splats(
    file: Path, data: Path | None, data_format: DataFormat | None, device_type: Any, up: Axis | None = None
) -> Loaded:
    """Load a file of Gaussians, in the scene of its data, or without data in a scene made from the Gaussians.

    Args:
        file: the file, in the frame of the input, or about a local origin given by an offset file beside it, and in the
            unit of the input, or of a scale beside it.
        data: folder of the photographs; None without.
        data_format: format of the data, with its flags; None to detect it.
        device_type: auto, cpu, cuda or mps.
        up: up axis in the frame of the file, for a file without data; None for that of the cameras beside it, or z.

    Raises:
        ConfigError: if the data do not fit.
        DataError: if the file or the data cannot be read.
    """
    gaussians, look = read_gaussians(file)
    say(f"{file}: {look.words()}")
    machine, scale = MachineConfig(device_type=device_type), read_scale(file)
    at = place(file, gaussians, read_offset(file), scale, data, data_format, machine, up)
    placed = transformed(gaussians, *at.frame.similarity())
    device = choose_device(machine)
    model = DrawnGaussians(placed.map(lambda values: values.to(device)), look, at.scene.to(device))
    return Loaded(model, at.placement, METHOD, file, file, source=at.source, scale=scale)


class Place(NamedTuple):
    """The place of a file's Gaussians in a scene."""

    frame: Placement
    """Placement of the file's coordinates in the scene."""
    placement: Placement
    """Placement of the input, in the unit of the file."""
    scene: Scene
    """The scene."""
    source: Run | None
    """Holds the data; None without."""


def place(
    file: Path,
    gaussians: Gaussians,
    offset: Tensor,
    scale: Scale,
    data: Path | None,
    data_format: DataFormat | None,
    machine: MachineConfig,
    up: Axis | None,
) -> Place:
    """Return the place of a file's Gaussians in the scene of its data, or without data in one made from them.

    Args:
        file: the file.
        gaussians: its Gaussians, or fewer that stand for them, in the frame of the file.
        offset: (3,) float64 origin of the file's coordinates in the frame of the input.
        scale: unit of the file.
        data: folder of the photographs; None without.
        data_format: format of the data, with its flags; None to detect it.
        machine: device of the model.
        up: up axis in the frame of the file, for a file without data; None for that of the cameras beside it, or z.

    Raises:
        ConfigError: if the data do not fit.
        DataError: if the data cannot be read, or are elsewhere.
    """
    if data is None and data_format is None:
        return _place_alone(gaussians, offset, read_cameras(file), up)
    if up is not None:
        raise ConfigError("--up has no effect with --data, which determines the up direction; leave it out")
    source = source_of(METHOD, file, data, data_format, machine)
    parsed = source.parse("train")
    scene, placement = scene_of(parsed, source.config), scale.placed(parsed.placement)
    frame = placement.about(offset)
    _check_place(file, gaussians, frame, parsed)
    return Place(frame, placement, scene, source)


def _place_alone(gaussians: Gaussians, offset: Tensor, cameras: CameraPath | None, up: Axis | None) -> Place:
    """Return the place of a file's Gaussians without data, where `cameras` that are kept beside it are known or not."""
    upwards = UP if up is None else direction_of(up)
    if up is None and cameras is not None and cameras.placement is not None:
        upwards = cameras.placement.up
    elif up is None:
        say("without photographs, z is assumed to point up (else: --up=-y, as in many captures, or --data DIR)")
    frame, scene = placed_gaussians(gaussians, upwards)
    placement = frame.about(-offset)
    if cameras is not None:
        poses = cameras.placed(placement).poses.float()
        scene = replace(scene, num_cameras=len(poses), camera_to_worlds=poses, unbounded=True)
    return Place(frame, placement, scene, None)


def _check_place(file: Path, given: Gaussians, frame: Placement, parsed: ParsedScene) -> None:
    """Check that cameras can see the Gaussians, and warn if the file has rounded their centres.

    Args:
        file: path of the file.
        given: the Gaussians in the frame of the file.
        frame: placement of this frame in the scene.
        parsed: the training images.

    Raises:
        DataError: if they are beyond the end of the scene.
    """
    middle = frame.points(given.means).median(0).values
    away = float((parsed.cameras.camera_to_worlds[:, :, 3].double() - middle).norm(dim=-1).min())
    beside = offset_file(file).name
    if not away < parsed.far:
        raise DataError(
            f"{file}: its Gaussians are {away:,.0f} scene units from the nearest camera, and the scene ends at "
            f"{parsed.far:g}; its frame differs from the data's; a file about a local origin needs {beside}"
        )
    if given.means.dtype == torch.float32 and local_origin(given.means, given.typical_size) is not None:
        say(
            f"{file}: so far from the origin, float32 has rounded its centres by up to {rounding(given.means):.2g}; "
            f"write it about a local origin, with the offset in {beside}"
        )
