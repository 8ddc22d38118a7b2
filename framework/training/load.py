"""Loading of a run, a folder of runs, a scene in blocks, a file of Gaussians, or an octree."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from nerfloom.base.config import HeldOutAppearance, RaysPerPixel
from nerfloom.base.errors import ConfigError
from nerfloom.blocks.files import is_blocks_file
from nerfloom.octrees.files import is_octree_file
from nerfloom.splats.files import is_splat_file
from nerfloom.splats.placement import Axis
from nerfloom.training.block_files import load_blocks
from nerfloom.training.file_data import DataFormat
from nerfloom.training.loaded import Loaded
from nerfloom.training.octree_files import load_octree
from nerfloom.training.splat_files import load_splats
from nerfloom.training.trained import load_trained


def load(
    path: Path,
    checkpoint: Path | None = None,
    device_type: Any = "auto",
    data: Path | None = None,
    rays_per_pixel: RaysPerPixel | None = None,
    eval_appearance: HeldOutAppearance | None = None,
    eval_rendering: Literal["volume", "surface"] | None = None,
    data_format: DataFormat | None = None,
    up: Axis | None = None,
) -> Loaded:
    """Load a trained run, a scene in blocks, a file of Gaussians, or an octree.

    Args:
        path: the run's folder, its config.yml, a folder above it (for its newest run), a blocks.yml, a file of
            Gaussians (.ply, .spz, .splat) in the frame of the input, or an octree (.octree).
        checkpoint: checkpoint of a run; None for the newest readable one.
        device_type: auto, cpu, cuda or mps.
        data: folder of the data, if a run's has moved; optional data for a file.
        rays_per_pixel: rays per rendered pixel; None for the run's setting.
        eval_appearance: appearance of held-out images; None for the run's setting.
        eval_rendering: rendering of a signed distance; None for the run's setting.
        data_format: data format for a file, with its flags; None to detect it.
        up: up axis of a file of Gaussians without data; None for z.

    Raises:
        ConfigError: if settings are missing or do not fit.
        CheckpointError: if there is no readable checkpoint, or it does not fit the settings.
        DataError: if the file or the data cannot be read.
    """
    if not is_splat_file(path) and not is_octree_file(path):
        if data_format is not None:
            raise ConfigError(f"'{data_format[0]}': the run knows its data format; leave it out, with its flags")
        if up is not None:
            raise ConfigError("--up is for files of Gaussians: the run knows which way is up; leave it out")
        if is_blocks_file(path):
            _refuse("a scene in blocks", {"load-checkpoint": checkpoint, "eval-appearance": eval_appearance})
            return load_blocks(path, device_type, data, rays_per_pixel, eval_rendering)
        return load_trained(path, checkpoint, device_type, data, rays_per_pixel, eval_appearance, eval_rendering)
    useless = {
        "load-checkpoint": checkpoint,
        "rays-per-pixel": rays_per_pixel,
        "eval-appearance": eval_appearance,
        "eval-rendering": eval_rendering,
    }
    _refuse("an octree" if is_octree_file(path) else "a file of Gaussians", useless)
    if is_octree_file(path):
        if up is not None:
            raise ConfigError("--up is for files of Gaussians: an octree knows which way is up; leave it out")
        return load_octree(path, data, data_format, device_type)
    return load_splats(path, data, data_format, device_type, up)


def _refuse(what: str, useless: dict[str, Any]) -> None:
    """Raise ConfigError if a flag that has no effect with what is loaded is given."""
    for flag, value in useless.items():
        if value is not None:
            raise ConfigError(f"--{flag} has no effect with {what}: leave it out")
