"""Photographs for a file of Gaussians or an octree."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import torch

from nerfloom.base.config import TrainConfig
from nerfloom.base.errors import ConfigError
from nerfloom.base.machine_config import MachineConfig
from nerfloom.data.dataset import load_dataset
from nerfloom.data.parsed_scene import DataParser, ParsedScene
from nerfloom.data.pixels.cache import PixelMemory
from nerfloom.data.scene import Scene
from nerfloom.registry import load_dataparser
from nerfloom.training.data_folder import find_data
from nerfloom.training.run import Run

LOOKED_AT = 4
"""Number of images to decode for the images' size and alpha."""
DataFormat = tuple[str, DataParser]
"""Name of a data format, and its flags."""


def source_of(
    method: str, file: Path, data: Path | None, data_format: DataFormat | None, machine: MachineConfig
) -> Run:
    """Return a placeholder run that holds the data.

    Args:
        method: name of the method that makes such files.
        file: path of the file.
        data: folder of the photographs; None for the embedded scene.
        data_format: format of the data, with its flags; None to detect it.
        machine: device of the model.
    """
    data, name = find_data(data, None if data_format is None else data_format[0])
    parser = load_dataparser(name)() if data_format is None else data_format[1]
    return Run(method, TrainConfig(data=data, machine=machine, vis="none"), name, parser, file.parent)


def scene_of(parsed: ParsedScene, config: TrainConfig) -> Scene:
    """Return the description of the scene of the training images `parsed`, after decoding a few by `config`.

    Raises:
        ConfigError: if rays are in normalised device coordinates.
    """
    few = parsed[torch.arange(min(LOOKED_AT, len(parsed.image_paths)))]
    scene = load_dataset(few, "train", PixelMemory.of(config.cache_limit, config.cache_dir), config.masks).scene
    if scene.warped:
        raise ConfigError("normalised device coordinates (--ndc) are for runs that were trained so; leave out --ndc")
    poses = parsed.cameras.camera_to_worlds
    return dataclasses.replace(scene, num_cameras=len(poses), camera_to_worlds=poses)
