"""Files of Gaussians, loaded like runs: drawn by gaussian-splatting in the scene that the data format makes."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Literal

import torch

from nerfloom.base.config import RaysPerPixel, TrainConfig
from nerfloom.base.console import say
from nerfloom.base.device import choose_device
from nerfloom.base.errors import ConfigError, DataError
from nerfloom.base.machine_config import MachineConfig
from nerfloom.data.dataset import DataParser, ParsedScene, load_dataset
from nerfloom.data.offsets import offset_file, read_offset
from nerfloom.data.pixels.cache import PixelMemory
from nerfloom.data.scene import Scene
from nerfloom.geometry.local_origin import local_origin, rounding
from nerfloom.registry import load_dataparser, load_method
from nerfloom.splats.files import is_splat_file, read_gaussians
from nerfloom.splats.gaussians import Gaussians, TakesGaussians
from nerfloom.splats.transform import transformed
from nerfloom.training.data_folder import find_data
from nerfloom.training.run import Run
from nerfloom.training.trained import Trained, build_model, load_trained

METHOD = "gaussian-splatting"
"""Method that draws the Gaussians of a file."""
LOOKED_AT = 4
"""Number of images that are decoded to know whether images have alpha, and how large they are."""
DataFormat = tuple[str, DataParser]
"""Name of a data format, and its flags."""


def load_run_or_splats(
    path: Path,
    checkpoint: Path | None = None,
    device_type: Any = "auto",
    data: Path | None = None,
    rays_per_pixel: RaysPerPixel | None = None,
    eval_appearance: Literal["mean", "half"] | None = None,
    data_format: DataFormat | None = None,
) -> Trained:
    """Load a run with its trained model, or a file of Gaussians as one.

    Args:
        path: the run's config.yml, its folder, or a file of Gaussians (.ply, .spz, .splat) in the frame of the input.
        checkpoint: as for `load_trained`; a file of Gaussians has none.
        device_type: auto, cpu, cuda or mps.
        data: folder of the data; that of the run if None.
        rays_per_pixel: as for `load_trained`; of no use for Gaussians.
        eval_appearance: as for `load_trained`; of no use for Gaussians.
        data_format: format of the data of a file of Gaussians; recognised if None.

    Raises:
        ConfigError: if settings are missing or do not fit.
        CheckpointError: if there is no readable checkpoint.
        DataError: if the file or the data cannot be read.
    """
    if not is_splat_file(path):
        if data_format is not None:
            raise ConfigError(f"'{data_format[0]}': the run knows its data format; leave it out, with its flags")
        return load_trained(path, checkpoint, device_type, data, rays_per_pixel, eval_appearance)
    useless = {"load-checkpoint": checkpoint, "rays-per-pixel": rays_per_pixel, "eval-appearance": eval_appearance}
    for flag, value in useless.items():
        if value is not None:
            raise ConfigError(f"--{flag} is of no use with a file of Gaussians: leave it out")
    return _load_splats(path, data, data_format, device_type)


def _load_splats(file: Path, data: Path | None, data_format: DataFormat | None, device_type: Any) -> Trained:
    """Return a run whose model draws the Gaussians of a file."""
    gaussians, look = read_gaussians(file)
    say(f"{file}: {look.words()}")
    if data is None and data_format is None:
        raise ConfigError(f"{file} is no run, and does not know its photographs: --data DIR")
    data, name = find_data(data, None if data_format is None else data_format[0])
    parser = load_dataparser(name)() if data_format is None else data_format[1]
    method = load_method(METHOD)
    settings: Any = method.config
    machine = MachineConfig(device_type=device_type)
    drawn = {"degree": gaussians.degree, **dataclasses.asdict(look)}
    config: TrainConfig = dataclasses.replace(settings, data=data, machine=machine, vis="none", **drawn)
    run, device = Run(METHOD, config, name, parser, file.parent), choose_device(machine)
    parsed = run.parse("train")
    scene = _scene(parsed, config)
    if scene.warped:
        raise ConfigError(f"{file}: normalised device coordinates (--ndc) have no place for Gaussians; leave out --ndc")
    model = build_model(METHOD, config, scene)
    if not isinstance(model, TakesGaussians):
        raise ConfigError(f"the installed method {METHOD} cannot take the Gaussians of a file")
    placement = parsed.placement
    placed = transformed(gaussians, *placement.about(read_offset(file)).similarity())
    _check_place(file, gaussians, placed, parsed)
    model.set_gaussians(placed)
    content = {"method": METHOD, "transform": placement.transform, "scale": placement.scale}
    return Trained(run, model.to(device).eval(), file, content)


def _check_place(file: Path, given: Gaussians, placed: Gaussians, parsed: ParsedScene) -> None:
    """Refuse Gaussians that no camera can see, and say if the file has rounded their centres.

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
            f"{parsed.far:g}, so it is in another frame than the data; a file about a local origin needs {beside}"
        )
    if given.means.dtype == torch.float32 and local_origin(given.means, given.typical_size) is not None:
        say(
            f"{file}: so far from the origin, float32 has rounded its centres by up to {rounding(given.means):.2g}; "
            f"write it about a local origin, with the offset in {beside}"
        )


def _scene(parsed: ParsedScene, config: TrainConfig) -> Scene:
    """Return the description of a scene, of which a few images are decoded."""
    few = parsed[torch.arange(min(LOOKED_AT, len(parsed.image_paths)))]
    scene = load_dataset(few, "train", PixelMemory.of(config.cache_limit, config.cache_dir), config.masks).scene
    poses = parsed.cameras.camera_to_worlds
    return dataclasses.replace(scene, num_cameras=len(poses), camera_to_worlds=poses)
