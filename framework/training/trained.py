"""Trained runs, loaded from their folders for evaluation, rendering and export."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from nerfloom.base.config import AppearanceConfig, RayConfig, RaysPerPixel, TrainConfig
from nerfloom.base.device import choose_device
from nerfloom.base.errors import CheckpointError, ConfigError, NerfloomError, is_out_of_memory
from nerfloom.cameras.poses import Placement
from nerfloom.data.scene import Scene
from nerfloom.model import Model, RendersFromImages
from nerfloom.registry import load_method
from nerfloom.training.checkpoint import FOLDER, find_newest, load_checkpoint
from nerfloom.training.data_folder import find_data
from nerfloom.training.datasets import load_split
from nerfloom.training.run import Run, read_run


@dataclass(frozen=True)
class Trained:
    """A run with its trained model."""

    run: Run
    """Method, settings, data and folder."""
    model: Model[Any]
    """Model in evaluation mode, on the device."""
    checkpoint: Path
    """File from which the parameters were read."""
    content: dict[str, Any]
    """Content of the checkpoint, with transform, scale and state."""

    @property
    def placement(self) -> Placement:
        """Placement of the input in the run's scene."""
        return Placement.of(self.content["transform"], self.content["scale"])


def load_trained(
    config_path: Path,
    checkpoint: Path | None = None,
    device_type: Any = "auto",
    data: Path | None = None,
    rays_per_pixel: RaysPerPixel | None = None,
    eval_appearance: Literal["mean", "half"] | None = None,
) -> Trained:
    """Load a run with its trained model.

    Args:
        config_path: the run's config.yml, or its folder.
        checkpoint: checkpoint to load; the newest readable one if None.
        device_type: auto, cpu, cuda or mps.
        data: folder of the data, if it has moved; the run's if None.
        rays_per_pixel: rays per rendered pixel; the run's if None.
        eval_appearance: appearance of held-out images; the run's if None.

    Raises:
        ConfigError: if the run's settings are missing or do not fit.
        CheckpointError: if there is no readable checkpoint, or it does not fit the settings.
    """
    run = read_run(config_path)
    machine = dataclasses.replace(run.config.machine, device_type=device_type)
    config = dataclasses.replace(
        run.config,
        machine=machine,
        data=run.config.data if data is None else find_data(data, run.dataparser)[0],
    )
    config = _changed(config, run.method, RayConfig, rays_per_pixel=rays_per_pixel)
    config = _changed(config, run.method, AppearanceConfig, eval_appearance=eval_appearance)
    run = dataclasses.replace(run, config=config)
    device = choose_device(machine)
    if checkpoint is None:
        newest = find_newest(run.folder / FOLDER, device)
        if newest is None:
            raise CheckpointError(f"{run.folder / FOLDER} holds no checkpoint")
        path, content = newest
    else:
        path, content = checkpoint, load_checkpoint(checkpoint, device)
    model = restored_model(run.method, config, content, device)
    if isinstance(model, RendersFromImages):
        model.show_images(load_split(run, "train").to(device))
    return Trained(run, model, path, content)


def _changed(config: TrainConfig, method: str, kind: type[TrainConfig], **values: Any) -> TrainConfig:
    """Return settings with the `values` that are not None; raise ConfigError if the method has no such settings."""
    given = {name: value for name, value in values.items() if value is not None}
    if given and not isinstance(config, kind):
        flag = next(iter(given)).replace("_", "-")
        raise ConfigError(f"--{flag} is of no use with {method}: leave it out")
    return dataclasses.replace(config, **given)


def build_model(method: str, config: TrainConfig, scene: Scene) -> Model[Any]:
    """Return a method's model with fresh parameters.

    Args:
        method: the method's name.
        config: the run's settings.
        scene: properties of the data.

    Raises:
        ConfigError: if the model needs more memory than the machine has, or the data shows several scenes, and the
            method learns one.
    """
    declared = load_method(method)
    if scene.num_scenes > 1 and not issubclass(declared.model, RendersFromImages):
        raise ConfigError(
            f"the data shows {scene.num_scenes} scenes, and {method} learns one: choose a method that learns from "
            "many, such as pixel-nerf, or data of one scene"
        )
    try:
        return declared.build(config, scene)
    except (MemoryError, RuntimeError) as error:
        if not is_out_of_memory(error):
            raise
        raise ConfigError(f"the settings make a model of {method} that this machine has no memory for") from error


def restored_model(method: str, config: TrainConfig, checkpoint: dict[str, Any], device: torch.device) -> Model[Any]:
    """Return the model of a checkpoint, in evaluation mode.

    Args:
        method: the method's name.
        config: the run's settings.
        checkpoint: content of the checkpoint, with the scene for which the model is built.
        device: device of the model.

    Raises:
        CheckpointError: if the checkpoint has no scene, no model can be built with the settings, or its parameters have
            other names or sizes.
    """
    try:
        scene = Scene.of(checkpoint.get("scene")).to("cpu")
    except ValueError as error:
        raise CheckpointError(f"the checkpoint lacks the scene: {error}") from error
    try:
        model = build_model(method, config, scene).to(device).eval()
    except NerfloomError:
        raise
    except (ArithmeticError, LookupError, MemoryError, RuntimeError, TypeError, ValueError) as error:
        raise CheckpointError(f"the settings make no model: {_short(error)}") from error
    restore_model(model, checkpoint, method)
    return model


def restore_model(model: Model[Any], checkpoint: dict[str, Any], method: str | None = None) -> None:
    """Load a checkpoint's parameters into a model.

    Args:
        model: the model.
        checkpoint: content of the checkpoint.
        method: name of the model's method; None to accept a checkpoint of any.

    Raises:
        CheckpointError: if the checkpoint is of another method, or its parameters have other names or sizes.
    """
    made_by = checkpoint.get("method")
    if None not in (made_by, method) and made_by != method:
        raise CheckpointError(f"the checkpoint is of {made_by}, and does not fit {method}: name one of its own")
    try:
        model.load_state_dict(checkpoint["model"])
    except (RuntimeError, TypeError, AttributeError, ValueError, LookupError, ArithmeticError, MemoryError) as error:
        reason = _difference(model.state_dict(), checkpoint["model"]) or _short(error)
        raise CheckpointError(f"the checkpoint does not fit the model's settings: {reason}") from error


def _difference(expected: dict[str, Any], found: Any) -> str:
    """Return the first difference of names or sizes of parameters, for people; empty if there is none."""
    if not isinstance(found, dict) or not all(isinstance(value, Tensor) for value in found.values()):
        return ""
    for name, value in expected.items():
        if name not in found:
            return f"it has no {name}; give the flags that it was trained with"
        if found[name].shape != value.shape:
            sizes = f"{_size(found[name])}, and by the settings {_size(value)}"
            return f"its {name} is {sizes}; give the flags that it was trained with"
    more = sorted(set(found) - set(expected))
    return f"it has {more[0]}, and the model has not; give the flags that it was trained with" if more else ""


def _size(value: Tensor) -> str:
    return "x".join(map(str, value.shape)) or "a number"


def _short(error: BaseException) -> str:
    """Return the message of an error on one line, at most 300 characters."""
    return (" ".join(str(error).split()) or type(error).__name__)[:300]
