"""Loading of files of levels, with or without their photographs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nerfloom.base.console import say
from nerfloom.base.device import choose_device
from nerfloom.base.machine_config import MachineConfig
from nerfloom.cameras.scale import read_scale
from nerfloom.levels.drawn import DrawnLevels
from nerfloom.levels.files import read_levels
from nerfloom.levels.settings import DetailSettings
from nerfloom.splats.placement import Axis
from nerfloom.training.file_data import DataFormat
from nerfloom.training.loaded import Loaded
from nerfloom.training.splat_files import METHOD, place


def load_levels(
    file: Path,
    data: Path | None,
    data_format: DataFormat | None,
    device_type: Any,
    up: Axis | None,
    settings: DetailSettings,
) -> Loaded:
    """Load a file of levels, in the scene of its data, or without data in a scene made from the Gaussians of its root.

    Args:
        file: the file, in the frame of the input, and in the unit of the input, or of a scale beside it.
        data: folder of the photographs; None without.
        data_format: format of the data, with its flags; None to detect it.
        device_type: auto, cpu, cuda or mps.
        up: up axis in the frame of the file, for a file without data; None for that of the cameras beside it, or z.
        settings: the detail of pictures, and the memory for it.

    Raises:
        ConfigError: if the data do not fit, or the memory is too small.
        DataError: if the file or the data cannot be read.
    """
    levels, scale, machine = read_levels(file), read_scale(file), MachineConfig(device_type=device_type)
    chunks, look = len(levels.nodes), levels.look
    say(f"{file}: {levels.num_gaussians:,} Gaussians, {chunks:,} chunks of all levels; {look.words()}")
    at = place(file, levels.read(chunks - 1), levels.origin, scale, data, data_format, machine, up)
    model = DrawnLevels(levels, at.frame, at.scene, choose_device(machine), settings)
    return Loaded(model, at.placement, METHOD, file, file, source=at.source, scale=scale)
