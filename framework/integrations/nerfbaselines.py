"""Adapter that runs Nerfloom's methods in nerfbaselines: its `Method` protocol, implemented by trainer and evaluator.

The protocol is structural, so nothing is imported from nerfbaselines. nerfbaselines counts the steps,
`max_num_iterations` in total. Overrides are named like the method's flags, with underscores (`max_num_iterations`,
`machine.seed`), or like the flags of `FrameFlags`, with the prefix `frame.`. A checkpoint is the trainer's, plus a file
with the background of renders.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.config import TrainConfig
from nerfloom.base.console import say
from nerfloom.base.device import choose_device
from nerfloom.base.errors import CheckpointError, ConfigError
from nerfloom.base.json_files import write_json
from nerfloom.base.plain import from_plain, to_plain
from nerfloom.cameras.view import View
from nerfloom.evaluation.appearance import fit_appearance, shown_appearance
from nerfloom.integrations.nerfbaselines_data import (
    CAMERA_MODELS,
    ArrayImages,
    DatasetDict,
    Frame,
    FrameFlags,
    background_of,
    cameras_of,
    dataset_of,
)
from nerfloom.integrations.nerfbaselines_settings import flattened, parse_overrides, with_matching_background
from nerfloom.registry import load_method
from nerfloom.renderable import refined_cameras
from nerfloom.training.checkpoint import FOLDER, load_newest
from nerfloom.training.trained import restored_model
from nerfloom.training.trainer import Trainer

BACKGROUND_FILE = "pictures.json"
"""File of a checkpoint with the background of renders, which the trainer's checkpoint lacks."""
FEATURES = ("color", "points3D_xyz")
"""Data set features in use. The points determine where rays start; sets of rendered objects have none."""
OUTPUTS = ("color", "depth", "accumulation")
"""Names of a render's arrays."""


class NerfloomMethod:
    """A method under nerfbaselines' protocol (`nerfbaselines.Method`). Subclasses set its name.

    Args:
        checkpoint: a folder written by `save`.
        train_dataset: training images; not needed to render from a checkpoint.
        config_overrides: settings by name, on top of the method's or the checkpoint's. Text is parsed as a Python
            literal; words such as `auto` are kept.

    Raises:
        ConfigError: for unknown settings, or if there are neither data nor a checkpoint.
        CheckpointError: for a checkpoint that is damaged or another method's.
        DataError: for invalid data.
    """

    name: ClassVar[str]
    """Name of the method in the registry."""

    def __init__(
        self,
        *,
        checkpoint: str | None = None,
        train_dataset: DatasetDict | None = None,
        config_overrides: Mapping[str, Any] | None = None,
    ) -> None:
        saved = None if checkpoint is None else Saved.read(Path(checkpoint), self.name)
        overrides = parse_overrides(config_overrides or {})
        flags = from_plain(FrameFlags(), overrides.pop("frame", {}), "config_overrides: frame")
        config = from_plain(_defaults(self.name, saved), overrides, "config_overrides")
        self._checkpoint = None if saved is None else saved.folder
        self._loaded_step = None if saved is None else int(saved.content["state"]["step"])
        self._trainer: Trainer | None = None
        if train_dataset is not None:
            trainer, self._frame, background = _begin(self.name, config, flags, train_dataset, saved)
            self._trainer, self._model, self._config = trainer, trainer.model, trainer.config
        elif saved is not None:
            self._frame, background, self._config = saved.frame, saved.background, config
            self._model = restored_model(load_method(self.name), config, saved.content, choose_device(config.machine))
        else:
            raise ConfigError(f"{self.name} needs training images or a checkpoint")
        self._background = background.to(self._model.device)

    # -- information for nerfbaselines --------------------------------------------------------------------------

    @classmethod
    def get_method_info(cls) -> dict[str, Any]:
        """Return nerfbaselines' `MethodInfo`; it fills in its own id of the method."""
        return {
            "method_id": "",
            "required_features": frozenset(FEATURES),
            "supported_camera_models": frozenset(CAMERA_MODELS),
            "supported_outputs": OUTPUTS,
            "can_resume_training": True,
        }

    def get_info(self) -> dict[str, Any]:
        """Return nerfbaselines' `ModelInfo`: method, length of training, settings, and loaded checkpoint."""
        return {
            **self.get_method_info(),
            "num_iterations": self._config.max_num_iterations,
            "batch_size": getattr(self._config, "num_rays_per_batch", 1),
            "eval_batch_size": getattr(self._config, "eval_num_rays_per_chunk", 1),
            "loaded_step": self._loaded_step,
            "loaded_checkpoint": None if self._checkpoint is None else str(self._checkpoint),
            "hparams": flattened(to_plain(self._config)),
        }

    # -- training ---------------------------------------------------------------------------------------------

    def train_iteration(self, step: int) -> dict[str, float]:
        """Run one training step.

        Args:
            step: number of the step, from 0.

        Returns:
            The loss, its terms, and the running PSNR of training pixels, dB.

        Raises:
            ConfigError: without training images, or if `step` is not the next step.
            DivergenceError: after ten consecutive non-finite steps.
        """
        if self._trainer is None:
            raise ConfigError("the method was loaded without training images")
        if step != self._trainer.state.step:
            raise ConfigError(f"step {step} is not the next step, {self._trainer.state.step}")
        report = self._trainer.train_step()
        terms = {f"loss_{name}": value for name, value in report.losses.items()}
        return {"loss": sum(report.losses.values()), "psnr": report.psnr, **terms}

    def save(self, path: str) -> None:
        """Write a checkpoint to the folder `path`.

        Raises:
            CheckpointError, OSError: if it cannot be written.
        """
        folder = Path(path)
        folder.mkdir(parents=True, exist_ok=True)
        if self._trainer is not None:
            self._trainer.folder = folder
            self._trainer.save()
        elif self._checkpoint is not None:  # the same bytes, because nerfbaselines stores their hash
            shutil.copytree(self._checkpoint / FOLDER, folder / FOLDER, dirs_exist_ok=True)
        write_json(folder / BACKGROUND_FILE, {"background": self._background.tolist()})

    # -- rendering --------------------------------------------------------------------------------------------

    def render(self, camera: Any, *, options: Mapping[str, Any] | None = None) -> dict[str, np.ndarray]:
        """Render the view of a camera.

        Args:
            camera: one of nerfbaselines' cameras, of any size and model.
            options: `embedding` is the appearance; if None, the mean of the training images'.

        Returns:
            color (H, W, 3) in [0, 1] over the data set's background, depth (H, W) along the ray in the data set's
            units, and accumulation (H, W), float32.
        """
        given = self._frame.placed(cameras_of([camera.item()], ["the camera"])).to(self._model.device)
        cameras = refined_cameras(self._model, given, training=False)
        with shown_appearance(self._model, self._vector((options or {}).get("embedding"))):
            picture = self._model.render_view(View.of(cameras, 0), self._background)
        found = (picture.rgb.clamp(0, 1), picture.median_depth / self._frame.placement.scale, picture.accumulation)
        return {name: values.cpu().numpy() for name, values in zip(OUTPUTS, found, strict=True)}

    def get_train_embedding(self, index: int) -> np.ndarray | None:
        """(D,) the appearance of training photograph `index`; None for methods without appearance."""
        appearance = self._model.appearance
        return None if appearance is None else appearance.of_images()[index].detach().cpu().numpy()

    def optimize_embedding(self, dataset: DatasetDict, *, embedding: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """Optimise the appearance of an image that is not a training image.

        Args:
            dataset: one image, or the visible part of it.
            embedding: (D,) initial value; if None, the mean of the training images'.

        Returns:
            `embedding` (D,).

        Raises:
            NotImplementedError: for a method without appearance, as nerfbaselines expects.
        """
        if self._model.appearance is None:
            raise NotImplementedError(f"{self.name} has learnt one appearance for all photographs")
        data = dataset_of(ArrayImages.of(dataset), self._frame, "ignored").to(self._model.device)
        data = replace(data, cameras=refined_cameras(self._model, data.cameras, training=False))
        pixels = torch.arange(len(data.pixels), device=data.device) if data.kept is None else data.kept.pixels()
        found = fit_appearance(self._model, data, pixels, self._background, self._vector(embedding))
        assert found is not None
        return {"embedding": found.cpu().numpy()}

    def _vector(self, embedding: np.ndarray | None) -> Tensor | None:
        """Return an embedding as a tensor; None for the mean of the learnt embeddings."""
        return None if embedding is None else torch.from_numpy(np.array(embedding, np.float32)).to(self._model.device)


class InstantNGP(NerfloomMethod):
    """Adapter of instant-ngp."""

    name = "instant-ngp"


class KPlanes(NerfloomMethod):
    """Adapter of kplanes."""

    name = "kplanes"


class Nerfacto(NerfloomMethod):
    """Adapter of nerfacto."""

    name = "nerfacto"


class TensoRF(NerfloomMethod):
    """Adapter of tensorf."""

    name = "tensorf"


class VanillaNeRF(NerfloomMethod):
    """Adapter of vanilla-nerf."""

    name = "vanilla-nerf"


@dataclass(frozen=True)
class Saved:
    """A checkpoint written by `NerfloomMethod.save`."""

    folder: Path
    """Folder of the checkpoint."""
    content: dict[str, Any]
    """Content of the trainer's checkpoint."""
    background: Tensor
    """(3,) colour behind renders."""

    @classmethod
    def read(cls, folder: Path, method: str) -> Saved:
        """Read the checkpoint of a `method` in `folder`.

        Raises:
            CheckpointError: if a file is missing or damaged, or the checkpoint is another method's.
        """
        content = load_newest(folder / FOLDER)
        if content is None:
            raise CheckpointError(f"{folder / FOLDER} has no checkpoint")
        if content.get("method") != method:
            raise CheckpointError(f"{folder} is a checkpoint of {content.get('method')}, not of {method}")
        try:
            background = torch.tensor(json.loads((folder / BACKGROUND_FILE).read_text(encoding="utf-8"))["background"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise CheckpointError(f"{folder / BACKGROUND_FILE} is missing or damaged: {error}") from error
        return cls(folder, content, background)

    @property
    def frame(self) -> Frame:
        """The frame of the data set in training."""
        return Frame.saved(self.content)


def _begin(
    method: str, config: TrainConfig, flags: FrameFlags, data: DatasetDict, saved: Saved | None
) -> tuple[Trainer, Frame, Tensor]:
    """Return a trainer, new or restored, the frame of its images, and the background of renders (3,).

    For a new trainer, decisions based on the data are reported.
    """
    images = ArrayImages.of(data)
    frame = Frame.of(images, flags) if saved is None else saved.frame
    dataset = dataset_of(images, frame, config.masks).to(choose_device(config.machine))
    background, has_alpha = background_of(data), dataset.scene.has_alpha
    if saved is None and has_alpha:
        config = with_matching_background(config, background)
    trainer = Trainer(load_method(method), config, dataset)
    if saved is not None:
        trainer.restore(saved.content)
        return trainer, frame, saved.background
    for line in trainer.profile.lines():
        say(line)
    return trainer, frame, background if has_alpha else trainer.model.background


def _defaults(method: str, saved: Saved | None) -> TrainConfig:
    """Return the settings before overrides. nerfbaselines' masks hide unwanted content, never empty space."""
    default = load_method(method).config
    if saved is None:
        return replace(default, masks="ignored")
    return from_plain(default, saved.content["config"], f"{saved.folder}: the checkpoint's settings")
