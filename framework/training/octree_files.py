"""Loading of octrees, with or without their photographs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from nerfloom.base.console import say
from nerfloom.base.device import choose_device
from nerfloom.base.errors import DataError
from nerfloom.base.machine_config import MachineConfig
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.scale import read_scale
from nerfloom.octrees.drawn import DrawnOctree
from nerfloom.octrees.files import read_octree
from nerfloom.training.file_data import DataFormat, scene_of, source_of
from nerfloom.training.loaded import Loaded

METHOD = "octree"
"""Method of such files."""
SHIFT = 1e-3
"""Maximum difference of two placements, scene units."""


def load_octree(file: Path, data: Path | None, data_format: DataFormat | None, device_type: Any) -> Loaded:
    """Load an octree, in the scene of its data, or without data in its stored scene.

    Args:
        file: the file.
        data: folder of the photographs; None without.
        data_format: format of the data, with its flags; None to detect it.
        device_type: auto, cpu, cuda or mps.

    Raises:
        ConfigError: if the data do not fit.
        DataError: if the file or the data cannot be read, or the data are placed elsewhere.
    """
    machine, octree = MachineConfig(device_type=device_type), read_octree(file)
    scene, source = octree.scene, None
    if data is not None or data_format is not None:
        source = source_of(METHOD, file, data, data_format, machine)
        parsed = source.parse("train")
        if not _same(octree.placement, parsed.placement):
            raise DataError(
                f"{file}: it was baked in another frame than the data's; name the format, with the flags of the run"
            )
        scene = scene_of(parsed, source.config)
    device = choose_device(machine)
    if device.type not in ("cpu", "cuda"):
        say(f"octrees have no kernels for {device.type} yet: rays take PyTorch's own operations, which are slow")
    model = DrawnOctree(octree.to(device), scene.to(device))
    return Loaded(model, octree.placement, METHOD, file, file, source=source).scaled(read_scale(file))


def _same(one: Placement, two: Placement) -> bool:
    """Return whether two placements put the same input at the same place, within the size of a scene."""
    around = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype=torch.float64)
    places = one.original_points(around)
    return float((two.points(places) - around).abs().max()) < SHIFT
