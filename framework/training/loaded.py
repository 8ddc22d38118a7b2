"""A loaded run or file of Gaussians, for rendering and evaluation."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nerfloom.base.errors import ConfigError
from nerfloom.base.splits import Split
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.view import View
from nerfloom.data.dataset import Dataset
from nerfloom.evaluation.evaluator import evaluate
from nerfloom.renderable import Renderable
from nerfloom.rendering.rendered import Picture
from nerfloom.training.datasets import load_split
from nerfloom.training.run import Run


@dataclass(frozen=True, repr=False)
class Loaded:
    """A renderable and its origin: the result of `nerfloom.load`."""

    model: Renderable
    """The renderable, on its device: a `nerfloom.Model` in evaluation mode, or Gaussians."""
    placement: Placement
    """Placement of the input in the scene of `model`."""
    method: str
    """Name of the method that made it."""
    origin: Path
    """The run's folder, or the file of Gaussians, for commands that load it again."""
    checkpoint: Path
    """File of the parameters."""
    step: int = 0
    """Number of training steps done; 0 if unknown."""
    source: Run | None = None
    """Method, settings, data and folder; None for Gaussians without data."""
    _datasets: dict[Split, Dataset] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Loaded({self.method!r}, {str(self.origin)!r})"

    @property
    def is_run(self) -> bool:
        """True for a run, False for a file of Gaussians."""
        return self.origin != self.checkpoint

    @property
    def folder(self) -> Path:
        """Folder for results: the run's folder, or the folder of the file."""
        return self.origin if self.is_run else self.origin.parent

    @property
    def unit(self) -> float:
        """Units of the input per scene unit."""
        return 1 / self.placement.scale

    @property
    def run(self) -> Run:
        """The run. For Gaussians with data it is a placeholder that holds the data.

        Raises:
            ConfigError: for Gaussians without data.
        """
        if self.source is None:
            raise ConfigError(f"{self.origin} is not a run, so that its photographs are unknown: give --data DIR")
        return self.source

    def dataset(self, split: Split = "test") -> Dataset:
        """Return the images of a split, with their cameras, on the model's device. They are read once.

        Args:
            split: train, val or test.

        Raises:
            ConfigError: for Gaussians without data.
            DataError: if the data cannot be read.
        """
        if split not in self._datasets:
            self._datasets[split] = load_split(self.run, split).to(self.model.device)
        return self._datasets[split]

    def views(self, split: Split = "test") -> list[View]:
        """Return a view for each image of `split`: train, val or test."""
        dataset = self.dataset(split)
        return [dataset.view(index) for index in range(len(dataset))]

    def render(self, camera: View | Cameras, time: float | None = None) -> Picture:
        """Render an image, with colour, depth and opacity.

        Args:
            camera: a view, or one camera.
            time: time in [0, 1] of a moving scene; None for the view's.

        Raises:
            ValueError: if there are several cameras.
        """
        if isinstance(camera, Cameras):
            if len(camera) != 1:
                raise ValueError(f"render() takes one camera, not {len(camera)}: choose one, as in cameras[0:1]")
            camera = View(camera.to(self.model.device), time)
        elif time is not None:
            camera = View(camera.camera, time, camera.rays_per_pixel, camera.stride)
        return self.model.render_view(camera, self.model.background)

    def evaluate(
        self, split: Split = "test", max_images: int | None = None, lpips_weights: str | Path | None = None
    ) -> dict[str, Any]:
        """Return PSNR in dB, SSIM and multi-scale SSIM, LPIPS and rendering speed, by their names in eval.json.

        Args:
            split: the images to compare with: train, val or test.
            max_images: maximum number of images, evenly spaced; None for all.
            lpips_weights: file of LPIPS weights; None for the run's setting.
        """
        weights = self.run.config.lpips_weights if lpips_weights is None else Path(lpips_weights)
        return evaluate(self.model, self.dataset(split), max_images=max_images, lpips_weights=weights).results
