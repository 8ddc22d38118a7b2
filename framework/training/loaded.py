"""A loaded run, file of Gaussians or octree, for rendering and evaluation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar, get_args

import torch
from torch import Tensor

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, DataError, nearest
from nerfloom.base.splits import Split
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.scale import Scale, write_scale
from nerfloom.cameras.view import View
from nerfloom.data.dataset import Dataset
from nerfloom.data.parsed_scene import ParsedScene
from nerfloom.evaluation.evaluator import evaluate
from nerfloom.evaluation.measuring import Length, measured, scale_of, surface_point
from nerfloom.renderable import Renderable, refined_cameras, with_refined_poses
from nerfloom.rendering.rendered import Picture
from nerfloom.training.datasets import load_split
from nerfloom.training.run import Run

LoadedT = TypeVar("LoadedT", bound="Loaded")


@dataclass(frozen=True, repr=False)
class Loaded:
    """A renderable and its origin: the result of `nerfloom.load`.

    Cameras of its data stand where `Renderable.refined_poses` puts them, in the frame of the renderable's scene.
    """

    model: Renderable
    """The renderable, on its device: a `nerfloom.Model` in evaluation mode, Gaussians, or an octree."""
    placement: Placement
    """Placement of the input, in the unit of `scale`, in the scene of `model`. All that is exported has this frame."""
    method: str
    """Name of the method that made it."""
    origin: Path
    """The run's folder, or the file, for commands that load it again."""
    checkpoint: Path
    """File of the parameters."""
    step: int = 0
    """Number of training steps done; 0 if unknown."""
    source: Run | None = None
    """Method, settings, data and folder; None for a file without data."""
    scale: Scale = field(default_factory=Scale)
    """The unit of lengths (docs/guides/measure.md)."""
    _datasets: dict[Split, Dataset] = field(default_factory=dict)
    _cameras: dict[Split, Cameras | None] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Loaded({self.method!r}, {str(self.origin)!r})"

    @property
    def is_run(self) -> bool:
        """True for a run, False for a file: of Gaussians, an octree, or a scene in blocks."""
        return self.origin != self.checkpoint

    @property
    def folder(self) -> Path:
        """Folder for results: the run's folder, or the folder of the file."""
        return self.origin if self.is_run else self.origin.parent

    @property
    def unit(self) -> float:
        """Length of a scene unit, in the unit of `scale`."""
        return 1 / self.placement.scale

    @property
    def input_placement(self) -> Placement:
        """Placement of the input in its own unit, for every `scale`."""
        return self.scale.unplaced(self.placement)

    @property
    def run(self) -> Run:
        """The run. For a file with data, and for a scene in blocks, it is a placeholder that holds the data.

        Raises:
            ConfigError: for a file without data.
        """
        if self.source is None:
            raise ConfigError(f"{self.origin} is not a run, so that its photographs are unknown: give --data DIR")
        return self.source

    def dataset(self, split: Split = "test") -> Dataset:
        """Return the images of a split, with their cameras, on the model's device. They are read once.

        Args:
            split: train, val or test.

        Raises:
            ConfigError: for a file without data.
            DataError: if the data cannot be read.
        """
        if split not in self._datasets:
            self._datasets[split] = load_split(self.run, split).to(self.model.device)
        return with_refined_poses(self.model, self._datasets[split])  # which change while it trains

    def parsed(self, split: Split) -> ParsedScene:
        """Return the images of a split, not decoded, with their cameras.

        Args:
            split: train, val or test.

        Raises:
            ConfigError: for a file without data.
            DataError: if the data cannot be read.
        """
        found = self.run.parse(split)
        return replace(found, cameras=refined_cameras(self.model, found.cameras, split == "train"))

    def views(self, split: Split = "test") -> list[View]:
        """Return a view for each image of `split`: train, val or test."""
        dataset = self.dataset(split)
        return [dataset.view(index) for index in range(len(dataset))]

    def photograph(self, name: str) -> View:
        """Return the view of a photograph, of any split. Photographs are not decoded.

        Args:
            name: its file name, or the end of its path, such as test/r_0.png.

        Raises:
            ConfigError: if no photograph or several have this name, or for a file without data.
            DataError: if the data cannot be read.
        """
        ending, known, found = Path(name).parts, set[str](), dict[Path, View]()
        for split in get_args(Split):
            try:
                parsed = self.parsed(split)
            except DataError:
                if split == "train":
                    raise
                continue
            for index, path in enumerate(parsed.image_paths):
                known.add(path.name)
                if path.parts[-len(ending) :] == ending:
                    found[path] = View.of(parsed.cameras.to(self.model.device), index, parsed.times)
        if not found:
            raise ConfigError(f"no photograph is named {name}. {nearest(name, known)}")
        if len(found) > 1:
            longer = "/".join(next(iter(found)).parts[-len(ending) - 1 :])
            raise ConfigError(f"{len(found)} photographs are named {name}: give more of the path, such as {longer}")
        return next(iter(found.values()))

    def render(self, camera: View | Cameras, time: float | None = None) -> Picture:
        """Render an image, with colour, depth and opacity.

        Args:
            camera: a view, or one camera.
            time: time in [0, 1] of a moving scene; None for the view's.

        Raises:
            ValueError: if there are several cameras.
        """
        view = self._view(camera)
        return self.model.render_view(view if time is None else replace(view, time=time), self.model.background)

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

    # -- measuring --------------------------------------------------------------------------------------------

    def pick(self, camera: View | Cameras, column: float, row: float) -> Tensor:
        """Return the position (3,) float64 of the surface at a pixel, in the frame of exports and the unit of `scale`.

        Args:
            camera: a view, or one camera.
            column, row: the pixel; (0, 0) is the centre of the top left one, and fractions are allowed.

        Raises:
            ConfigError: if the pixel is outside of the image or shows no surface, or the run has no lengths
                (`measure`).
            ValueError: if there are several cameras.
        """
        self._check_lengths()
        return self.placement.original_points(surface_point(self.model, self._view(camera), column, row)[None])[0]

    def measure(
        self, start: Tensor | Sequence[float], end: Tensor | Sequence[float], time: float | None = None
    ) -> Length:
        """Return the distance between two points, with its error (docs/guides/measure.md).

        Args:
            start, end: the points x, y, z, in the frame of exports and the unit of `scale`, as `pick` returns them.
            time: time in [0, 1] of a moving scene; None for 0.

        Raises:
            ConfigError: if the points are the same, or the run has no lengths: normalised device coordinates, or
                several scenes.
        """
        return self._measured(start, end, self.scale, time)

    def with_scale(
        self: LoadedT,
        start: Tensor | Sequence[float],
        end: Tensor | Sequence[float],
        distance: float,
        unit: str = "m",
        time: float | None = None,
    ) -> LoadedT:
        """Return this in a scale that gives two points a known distance; `keep_scale` writes the scale to the run.

        Args:
            start, end: the points, as in `measure`.
            distance: their true distance.
            unit: name of the distance's unit.
            time: time in [0, 1] of a moving scene; None for 0.

        Raises:
            ConfigError: if the points are the same, or the distance or the name cannot be used.
        """
        found = self._measured(start, end, replace(self.scale, relative_error=0.0), time)
        return self.scaled(scale_of(found, self.scale, distance, unit))

    def scaled(self: LoadedT, scale: Scale) -> LoadedT:
        """Return this in another `scale`."""
        return replace(self, placement=scale.placed(self.input_placement), scale=scale)

    def keep_scale(self) -> None:
        """Write the scale to the run's folder, where all commands find it.

        Raises:
            ConfigError: for a file, because its coordinates are in a unit already.
            OSError: if it cannot be written.
        """
        if not self.is_run:
            raise ConfigError(
                f"{self.origin} is not a run and keeps its coordinates: set the scale of the run that it is from, and "
                "export or bake that again"
            )
        write_scale(self.folder, self.scale)

    def _measured(
        self, start: Tensor | Sequence[float], end: Tensor | Sequence[float], scale: Scale, time: float | None
    ) -> Length:
        self._check_lengths()
        ends = self.placement.points(torch.stack([torch.as_tensor(p, dtype=torch.float64) for p in (start, end)]))
        return measured(self.model, self._photographs(), (ends[0], ends[1]), self.unit, scale, time)

    def _check_lengths(self) -> None:
        """Raise ConfigError if there are no lengths in the scene, or no single scene."""
        if self.model.scene.warped:
            raise ConfigError("this run is in normalised device coordinates (--ndc), which have no lengths to measure")
        if self.model.scene.num_scenes > 1:
            raise ConfigError(f"this run is of {self.model.scene.num_scenes} scenes; lengths are measured in one")

    def _photographs(self) -> Cameras | None:
        """Return the cameras of the training images, in the sizes that were learnt from; None if they are not known.

        The images are not decoded.
        """
        if "train" not in self._cameras:
            try:
                parsed = None if self.source is None else self.source.parse("train")
            except DataError as error:
                say(f"the errors of lengths are not known: {error}")
                parsed = None
            self._cameras["train"] = None if parsed is None else parsed.cameras.scaled(1 / parsed.downscale_factor)
        given = self._cameras["train"]
        return None if given is None else refined_cameras(self.model, given, training=True)

    def _view(self, camera: View | Cameras) -> View:
        """Return a view as it is, or the view of one camera on the model's device."""
        if isinstance(camera, View):
            return camera
        if len(camera) != 1:
            raise ValueError(f"a view is of one camera, not of {len(camera)}: choose one, as in cameras[0:1]")
        return View(camera.to(self.model.device))
