"""Nerfloom's methods as nerfbaselines runs them: its `Method` protocol around the trainer and the evaluator.

The protocol is structural, so nothing of nerfbaselines is imported. It trains for `max_num_iterations` steps, its
trainer counting them; overrides have the names of the method's flags, with underscores (`max_num_iterations`,
`machine.seed`), or of `FrameFlags` after `frame.`. A checkpoint is the trainer's, beside the background of pictures.
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

from framework.base.config import TrainConfig, from_plain, to_plain
from framework.base.console import say
from framework.base.device import choose_device
from framework.base.errors import CheckpointError, ConfigError, DataError
from framework.base.registry import load_method
from framework.cameras.view import View
from framework.data.dataset import DataParser, ParsedScene, Split
from framework.evaluation.appearance import appearance_of, fit_appearance, shown_appearance
from framework.evaluation.evaluator import evaluation_background
from framework.tools.integrations.nerfbaselines_data import (
    CAMERA_MODELS,
    Frame,
    FrameFlags,
    Handed,
    Photographs,
    background_of,
    cameras_of,
    dataset_of,
)
from framework.tools.integrations.nerfbaselines_settings import flattened, over_any, parse_overrides
from framework.training.checkpoint import FOLDER, load_newest
from framework.training.run import Run, write_json
from framework.training.trained import restored_model
from framework.training.trainer import Trainer

PICTURES = "pictures.json"
"""The file of a checkpoint that says what the trainer's does not: the background of pictures."""
FEATURES = ("color", "points3D_xyz")
"""What data sets are asked for; the points tell where rays may start, and a set of rendered objects has none."""
OUTPUTS = ("color", "depth", "accumulation")


class NerfloomMethod:
    """One method under nerfbaselines' protocol (`nerfbaselines.Method`). Subclasses name it.

    Args:
        checkpoint: a folder that `save` has written.
        train_dataset: photographs to learn from; needed unless there is a checkpoint that is only to be looked at.
        config_overrides: settings by name, on top of the method's own or of the checkpoint's; text is read as Python
            would, words such as `auto` standing for themselves.
    Raises: ConfigError for unknown settings, or for neither data nor checkpoint; CheckpointError for a checkpoint that
        is damaged or another method's; DataError for data that cannot be used.
    """

    name: ClassVar[str]
    """The method's in our registry."""

    def __init__(
        self,
        *,
        checkpoint: str | None = None,
        train_dataset: Handed | None = None,
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
            self._model = restored_model(self.name, config, saved.content, choose_device(config.machine))
        else:
            raise ConfigError(f"{self.name} needs photographs to learn from, or a checkpoint")
        self._background = background.to(self._model.device)

    # -- what nerfbaselines is told ---------------------------------------------------------------------------

    @classmethod
    def get_method_info(cls) -> dict[str, Any]:
        """nerfbaselines' `MethodInfo`; it fills in the id that it knows the method by."""
        return {
            "method_id": "",
            "required_features": frozenset(FEATURES),
            "supported_camera_models": frozenset(CAMERA_MODELS),
            "supported_outputs": OUTPUTS,
            "can_resume_training": True,
        }

    def get_info(self) -> dict[str, Any]:
        """nerfbaselines' `ModelInfo`: the above, how long to train, the settings, and what was loaded."""
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
        """One step of training, the `step`-th from 0.

        Returns: the loss and its terms, and the running PSNR of training pixels, dB.
        Raises: ConfigError without photographs, or out of turn; DivergenceError after ten non-finite steps in a row.
        """
        if self._trainer is None:
            raise ConfigError("there are no photographs to learn from: the method was loaded without")
        if step != self._trainer.state.step:
            raise ConfigError(f"step {step} is not the next one, which is {self._trainer.state.step}")
        report = self._trainer.train_step()
        terms = {f"loss_{name}": value for name, value in report.losses.items()}
        return {"loss": sum(report.losses.values()), "psnr": report.psnr, **terms}

    def save(self, path: str) -> None:
        """Write a checkpoint into the folder `path`.

        Raises: CheckpointError or OSError where it cannot be written.
        """
        folder = Path(path)
        folder.mkdir(parents=True, exist_ok=True)
        if self._trainer is not None:
            self._trainer.run = replace(self._trainer.run, folder=folder)
            self._trainer.save()
        elif self._checkpoint is not None:  # the same bytes, of which nerfbaselines keeps a hash
            shutil.copytree(self._checkpoint / FOLDER, folder / FOLDER, dirs_exist_ok=True)
        write_json(folder / PICTURES, {"background": self._background.tolist()})

    # -- pictures ---------------------------------------------------------------------------------------------

    def render(self, camera: Any, *, options: Mapping[str, Any] | None = None) -> dict[str, np.ndarray]:
        """What a camera sees.

        Args:
            camera: one of nerfbaselines' cameras, of any size and model.
            options: `embedding` is the appearance to show, the training photographs' mean if None.
        Returns: color (H, W, 3) in [0, 1] over the data set's background, depth (H, W) along the ray in the data set's
            units, and accumulation (H, W), float32.
        """
        cameras = self._frame.placed(cameras_of([camera.item()], ["the camera"])).to(self._model.device)
        with shown_appearance(self._model, self._vector((options or {}).get("embedding"))):
            picture = self._model.render_view(View.of(cameras, 0), self._background)
        found = (picture.rgb.clamp(0, 1), picture.median_depth / self._frame.placement.scale, picture.accumulation)
        return {name: values.cpu().numpy() for name, values in zip(OUTPUTS, found, strict=True)}

    def get_train_embedding(self, index: int) -> np.ndarray | None:
        """(D,) the appearance of training photograph `index`; None of a method that learns none."""
        appearance = appearance_of(self._model)
        return None if appearance is None else appearance.vectors[index].detach().cpu().numpy()

    def optimize_embedding(self, dataset: Handed, *, embedding: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """The appearance of a photograph that was not trained on.

        Args:
            dataset: one photograph, or what may be seen of it.
            embedding: (D,) to start from; the training photographs' mean if None.
        Returns: `embedding` (D,).
        Raises: NotImplementedError of a method that learns no appearance, which nerfbaselines takes for an answer.
        """
        if appearance_of(self._model) is None:
            raise NotImplementedError(f"{self.name} has learnt one appearance for all photographs")
        data = dataset_of(Photographs.of(dataset), self._frame, "ignored").to(self._model.device)
        pixels = torch.arange(len(data.pixels), device=data.device) if data.kept is None else data.kept.pixels()
        found = fit_appearance(self._model, data, pixels, self._background, self._vector(embedding))
        assert found is not None
        return {"embedding": found.cpu().numpy()}

    def _vector(self, embedding: np.ndarray | None) -> Tensor | None:
        """Return an embedding as a tensor; None for the mean of what was learnt."""
        return None if embedding is None else torch.from_numpy(np.array(embedding, np.float32)).to(self._model.device)


class InstantNGP(NerfloomMethod):
    """instant-ngp for nerfbaselines."""

    name = "instant-ngp"


class KPlanes(NerfloomMethod):
    """kplanes for nerfbaselines."""

    name = "kplanes"


class Nerfacto(NerfloomMethod):
    """nerfacto for nerfbaselines."""

    name = "nerfacto"


class TensoRF(NerfloomMethod):
    """tensorf for nerfbaselines."""

    name = "tensorf"


class VanillaNeRF(NerfloomMethod):
    """vanilla-nerf for nerfbaselines."""

    name = "vanilla-nerf"


@dataclass(frozen=True)
class Saved:
    """What `save` has written."""

    folder: Path
    """Where."""
    content: dict[str, Any]
    """The trainer's checkpoint."""
    background: Tensor
    """(3,) behind what is not opaque in a picture."""

    @classmethod
    def read(cls, folder: Path, method: str) -> Saved:
        """Read it.

        Raises: CheckpointError where something is missing, damaged, or another method's.
        """
        content = load_newest(folder / FOLDER)
        if content is None:
            raise CheckpointError(f"{folder / FOLDER} holds no checkpoint")
        if content.get("method") != method:
            raise CheckpointError(f"{folder} is a checkpoint of {content.get('method')}, not of {method}")
        try:
            background = torch.tensor(json.loads((folder / PICTURES).read_text(encoding="utf-8"))["background"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise CheckpointError(f"{folder / PICTURES} is missing or damaged: {error}") from error
        return cls(folder, content, background)

    @property
    def frame(self) -> Frame:
        """Where the data set lay when it was learnt."""
        return Frame.saved(self.content)


@dataclass(frozen=True)
class ReadByNerfbaselines(DataParser):
    """Stands where a run names its data format: nerfbaselines has read the data already."""

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return False

    def parse(self, path: Path | None, split: Split) -> ParsedScene:
        raise DataError("nerfbaselines reads the data of its runs; there are no files to parse")


def _begin(
    method: str, config: TrainConfig, flags: FrameFlags, handed: Handed, saved: Saved | None
) -> tuple[Trainer, Frame, Tensor]:
    """A trainer at its start, or as it was saved; where its photographs lie; and what is behind them in pictures (3,).

    What the data decided is said at the start.
    """
    photographs = Photographs.of(handed)
    frame = Frame.of(photographs, flags) if saved is None else saved.frame
    dataset = dataset_of(photographs, frame, config.masks).to(choose_device(config.machine))
    background, transparent = background_of(handed), dataset.scene.has_alpha
    if saved is None and transparent:
        config = over_any(config, background)
    trainer = Trainer(Run(method, config, "nerfbaselines", ReadByNerfbaselines(), Path()), dataset, None)
    if saved is not None:
        trainer.restore(saved.content)
        return trainer, frame, saved.background
    for line in trainer.profile().lines():
        say(line)
    return trainer, frame, background if transparent else evaluation_background(trainer.model)


def _defaults(method: str, saved: Saved | None) -> TrainConfig:
    """The settings before any override. nerfbaselines' masks hide what disturbs; they never say that it is empty."""
    default = load_method(method).config
    if saved is None:
        return replace(default, masks="ignored")
    return from_plain(default, saved.content["config"], f"{saved.folder}: the checkpoint's settings")
