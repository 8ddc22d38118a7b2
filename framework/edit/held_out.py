"""The cost of an edit: PSNR of the edited Gaussians on held-out photographs."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import fmean

import torch
from torch import Tensor

from nerfloom.base.console import track
from nerfloom.cameras.view import View
from nerfloom.data.dataset import Dataset
from nerfloom.edit.edited import Edited
from nerfloom.evaluation.evaluator import measure_view, views_to_judge
from nerfloom.renderable import Renderable, with_refined_poses
from nerfloom.rendering.rendered import Picture
from nerfloom.splats.gaussians import Gaussians, RendersGaussians
from nerfloom.training.datasets import first_split
from nerfloom.training.loaded import Loaded


class Redrawn(Renderable):
    """A `model` that draws other `gaussians` (N, float32, in the frame of its scene) instead of its own."""

    def __init__(self, model: Renderable, gaussians: Gaussians) -> None:
        self.scene, self._model, self._gaussians = model.scene, model, gaussians

    @property
    def device(self) -> torch.device:
        return self._model.device

    @property
    def background(self) -> Tensor:
        return self._model.background

    def render_view(self, view: View, background: Tensor) -> Picture:
        assert isinstance(self._model, RendersGaussians)
        return self._model.render_gaussians(self._gaussians, view, background)


@dataclass(frozen=True)
class HeldOut:
    """Held-out photographs that edits are compared with."""

    model: Renderable
    """The model with the Gaussians that are edited."""
    dataset: Dataset
    """The photographs, on its device."""
    views: tuple[int, ...]
    """The photographs that count."""

    @classmethod
    def of(cls, loaded: Loaded, max_images: int) -> HeldOut | None:
        """Return up to `max_images` held-out photographs of `loaded`; None if unknown or of other moments."""
        model = loaded.model
        if loaded.source is None or model.scene.moving or not isinstance(model, RendersGaussians) or max_images < 1:
            return None
        dataset = first_split(loaded.source, ("test", "val"), max_images)
        if dataset is None or not (views := views_to_judge(dataset)):
            return None
        seen = with_refined_poses(model, dataset.to(model.device))
        return cls(model, seen, tuple(views[:max_images]))

    def psnr(self, edited: Edited) -> float:
        """Return the mean PSNR of the `edited` Gaussians, dB."""
        redrawn = Redrawn(self.model, edited.in_scene())
        views = track(self.views, "Comparing with held-out photographs", total=len(self.views))
        return fmean(measure_view(redrawn, self.dataset, index, redrawn.background).psnr for index in views)
