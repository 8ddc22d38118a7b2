"""Loading of files of Gaussians, with or without their photographs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from nerfloom.base.console import say
from nerfloom.base.device import choose_device
from nerfloom.base.errors import ConfigError, DataError
from nerfloom.base.machine_config import MachineConfig
from nerfloom.cameras.scale import read_scale
from nerfloom.data.offsets import offset_file, read_offset
from nerfloom.data.parsed_scene import ParsedScene
from nerfloom.geometry.local_origin import local_origin, rounding
from nerfloom.splats.drawn import DrawnGaussians
from nerfloom.splats.files import read_gaussians
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.placement import Axis, placed_gaussians
from nerfloom.splats.transform import transformed
from nerfloom.training.file_data import DataFormat, scene_of, source_of
from nerfloom.training.loaded import Loaded

METHOD = "gaussian-splatting"
"""Method of such files, whichever program wrote them."""


def load_splats(
    file: Path, data: Path | None, data_format: DataFormat | None, device_type: Any, up: Axis | None = None
) -> Loaded:
    """Load a file of Gaussians, in the scene of its data, or without data in a scene made from the Gaussians.

    Args:
        file: the file, in the frame of the input, or about a local origin given by an offset file beside it, and in the
            unit of the input, or that of a scale beside it.
        data: folder of the photographs; None without.
        data_format: format of the data, with its flags; None to detect it.
        device_type: auto, cpu, cuda or mps.
        up: up axis in the frame of the file, for a file without data; None for z.

    Raises:
        ConfigError: if the data do not fit.
        DataError: if the file or the data cannot be read.
    """
    gaussians, look = read_gaussians(file)
    say(f"{file}: {look.words()}")
    machine, offset, scale = MachineConfig(device_type=device_type), read_offset(file), read_scale(file)
    if data is None and data_format is None:
        source, (about, scene) = None, placed_gaussians(gaussians, up or "z")
        if up is None:
            say("without photographs, z is assumed to point up (else: --up=-y, as in many captures, or --data DIR)")
        placed = transformed(gaussians, *about.similarity())
        placement = about.about(-offset)
    elif up is not None:
        raise ConfigError("--up has no effect with --data, which determines the up direction; leave it out")
    else:
        source = source_of(METHOD, file, data, data_format, machine)
        parsed = source.parse("train")
        scene, placement = scene_of(parsed, source.config), scale.placed(parsed.placement)
        placed = transformed(gaussians, *placement.about(offset).similarity())
        _check_place(file, gaussians, placed, parsed)
    device = choose_device(machine)
    model = DrawnGaussians(placed.map(lambda values: values.to(device)), look, scene.to(device))
    return Loaded(model, placement, METHOD, file, file, source=source, scale=scale)


def _check_place(file: Path, given: Gaussians, placed: Gaussians, parsed: ParsedScene) -> None:
    """Check that cameras can see the Gaussians, and warn if the file has rounded their centres.

    Args:
        file: path of the file.
        given: the Gaussians in the frame of the file.
        placed: the Gaussians in the frame of the scene.
        parsed: the training images.

    Raises:
        DataError: if they are beyond the end of the scene.
    """
    middle = placed.means.double().median(0).values
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
