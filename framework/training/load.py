"""Loading of a run, a folder of runs, a scene in blocks, a file of Gaussians or of levels, or an octree."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from nerfloom.base.changed import changed, refuse
from nerfloom.base.errors import ConfigError
from nerfloom.blocks.files import is_blocks_file
from nerfloom.levels.files import is_levels_file
from nerfloom.levels.settings import DetailSettings
from nerfloom.octrees.files import is_octree_file
from nerfloom.splats.files import is_splat_file
from nerfloom.splats.placement import Axis
from nerfloom.training.block_files import load_blocks
from nerfloom.training.file_data import DataFormat
from nerfloom.training.level_files import load_levels
from nerfloom.training.loaded import Loaded
from nerfloom.training.octree_files import load_octree
from nerfloom.training.splat_files import load_splats
from nerfloom.training.trained import load_trained


def load(
    path: Path,
    checkpoint: Path | None = None,
    device_type: Any = "auto",
    data: Path | None = None,
    data_format: DataFormat | None = None,
    up: Axis | None = None,
    **settings: Any,
) -> Loaded:
    """Load a trained run, a scene in blocks, a file of Gaussians or of levels, or an octree.

    Args:
        path: the run's folder, its config.yml, a folder above it (for its newest run), a blocks.yml, a file of
            Gaussians (.ply, .spz, .sog, .splat, .ksplat) in the frame of the input, or a file of levels (.levels),
            or an octree (.octree).
        checkpoint: checkpoint of a run; None for the newest readable one.
        device_type: auto, cpu, cuda or mps.
        data: folder of the data, if a run's has moved; optional data for a file.
        data_format: data format for a file, with its flags; None to detect it.
        up: up axis of a file of Gaussians without data; None for that of the cameras kept beside it, or else z.
        settings: changed settings by name, of a run (as in `rays_per_pixel=4`) or of a file of levels
            (`DetailSettings`); None for its own value.

    Raises:
        ConfigError: if settings are missing or do not fit.
        CheckpointError: if there is no readable checkpoint, or it does not fit the settings.
        DataError: if the file or the data cannot be read.
    """
    if is_levels_file(path):
        what = "levels of detail"
        refuse({"load_checkpoint": checkpoint}, what)
        return load_levels(path, data, data_format, device_type, up, changed(DetailSettings(), settings, what))
    is_octree = is_octree_file(path)
    if not is_octree and not is_splat_file(path):
        if data_format is not None:
            raise ConfigError(f"'{data_format[0]}': the run knows its data format; leave it out, with its flags")
        if up is not None:
            raise ConfigError("--up is for files of Gaussians: the run knows which way is up; leave it out")
        if is_blocks_file(path):
            refused = {"load_checkpoint": checkpoint, "eval_appearance": settings.pop("eval_appearance", None)}
            refuse(refused, "a scene in blocks")
            return load_blocks(path, device_type, data, **settings)
        return load_trained(path, checkpoint, device_type, data, **settings)
    refuse({"load_checkpoint": checkpoint, **settings}, "an octree" if is_octree else "a file of Gaussians")
    if is_octree:
        if up is not None:
            raise ConfigError("--up is for files of Gaussians: an octree knows which way is up; leave it out")
        return load_octree(path, data, data_format, device_type)
    return load_splats(path, data, data_format, device_type, up)
