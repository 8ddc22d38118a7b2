"""Trained runs, loaded from their folders for evaluation, rendering and export."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.changed import changed
from nerfloom.base.config import TrainConfig
from nerfloom.base.device import choose_device
from nerfloom.base.errors import CheckpointError, NerfloomError, one_line
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.scale import read_scale
from nerfloom.data.scene import Scene
from nerfloom.method import Method
from nerfloom.model import Model
from nerfloom.registry import load_method
from nerfloom.renderable import RendersFromImages
from nerfloom.training.checkpoint import FOLDER, find_newest, load_checkpoint
from nerfloom.training.data_folder import find_data
from nerfloom.training.datasets import load_split
from nerfloom.training.loaded import Loaded
from nerfloom.training.run import Run, read_run


def load_trained(
    config_path: Path,
    checkpoint: Path | None = None,
    device_type: Any = "auto",
    data: Path | None = None,
    **settings: Any,
) -> Loaded:
    """Load a run with its trained model.

    Args:
        config_path: the run's config.yml, or its folder.
        checkpoint: checkpoint to load; None for the newest readable one.
        device_type: auto, cpu, cuda or mps.
        data: folder of the data, if it has moved; None for the run's.
        settings: changed settings, by name, as in `rays_per_pixel=4`; None for the run's own value.

    Raises:
        ConfigError: if the run's settings are missing or do not fit.
        CheckpointError: if there is no readable checkpoint, or it does not fit the settings.
        DataError: if the run's scale cannot be read.
    """
    run = read_run(config_path)
    config = dataclasses.replace(
        changed(run.config, settings, run.method),
        machine=dataclasses.replace(run.config.machine, device_type=device_type),
        data=run.config.data if data is None else find_data(data, run.dataparser)[0],
    )
    return load_parameters(dataclasses.replace(run, config=config), checkpoint)


def load_parameters(run: Run, checkpoint: Path | None = None) -> Loaded:
    """Load the trained model of `run`, with known settings, from `checkpoint` or the newest readable one.

    Raises:
        ConfigError: if the settings do not fit.
        CheckpointError: if there is no readable checkpoint, or it does not fit the settings.
        DataError: if the run's scale cannot be read.
    """
    device = choose_device(run.config.machine)
    if checkpoint is None:
        newest = find_newest(run.folder / FOLDER, device)
        if newest is None:
            raise CheckpointError(f"{run.folder / FOLDER} holds no checkpoint")
        path, content = newest
    else:
        path, content = checkpoint, load_checkpoint(checkpoint, device)
    model = restored_model(load_method(run.method), run.config, content, device)
    if isinstance(model, RendersFromImages):
        model.show_images(load_split(run, "train").to(device))
    placement, state = Placement.of(content["transform"], content["scale"]), content.get("state")
    step = state.get("step") if isinstance(state, dict) else None
    loaded = Loaded(model, placement, run.method, run.folder, path, step if isinstance(step, int) else 0, run)
    return loaded.scaled(read_scale(run.folder))


def restored_model(method: Method, config: TrainConfig, checkpoint: dict[str, Any], device: torch.device) -> Model[Any]:
    """Return the model of a `checkpoint`, which has its scene, in evaluation mode on `device`.

    Raises:
        CheckpointError: if the checkpoint has no scene, no model can be built with the settings, or its parameters have
            other names or sizes.
    """
    try:
        scene = Scene.of(checkpoint.get("scene")).to("cpu")
    except ValueError as error:
        raise CheckpointError(f"the checkpoint lacks the scene: {error}") from error
    try:
        model = method.build(config, scene).to(device).eval()
    except NerfloomError:
        raise
    except (ArithmeticError, LookupError, MemoryError, RuntimeError, TypeError, ValueError) as error:
        raise CheckpointError(f"no model can be built with the settings: {one_line(error)}") from error
    restore_model(model, checkpoint, method.name)
    return model


def restore_model(model: Model[Any], checkpoint: dict[str, Any], method: str | None = None) -> None:
    """Load the parameters of a `checkpoint` into `model`; a `method` that is not None must be the checkpoint's.

    Raises:
        CheckpointError: if the checkpoint is of another method, or its parameters have other names or sizes.
    """
    made_by = checkpoint.get("method")
    if None not in (made_by, method) and made_by != method:
        raise CheckpointError(f"the checkpoint is of {made_by}, and does not fit {method}: name one of this method")
    try:
        model.load_state_dict(checkpoint["model"])
    except (RuntimeError, TypeError, AttributeError, ValueError, LookupError, ArithmeticError, MemoryError) as error:
        reason = _difference(model.state_dict(), checkpoint["model"]) or one_line(error)
        raise CheckpointError(f"the checkpoint does not fit the model's settings: {reason}") from error


def _difference(expected: dict[str, Any], found: Any) -> str:
    """Return the first difference in names or sizes of parameters, as text; empty if there is none."""
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
