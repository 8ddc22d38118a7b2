"""Training of methods, and rendering and evaluation of trained runs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from nerfloom.base.config import from_plain, to_plain
from nerfloom.base.splits import Split
from nerfloom.base.step_limit import limited_as_given
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.view import View
from nerfloom.data.dataset import Dataset
from nerfloom.evaluation.evaluator import evaluate, evaluation_background
from nerfloom.registry import load_dataparser, load_method, registered, summary
from nerfloom.rendering.rendered import Picture
from nerfloom.training.data_folder import find_data
from nerfloom.training.datasets import load_split
from nerfloom.training.run import Run, run_folder
from nerfloom.training.run_path import config_file
from nerfloom.training.trained import Trained, load_trained

if TYPE_CHECKING:
    from PIL.Image import Image

Device = Literal["auto", "cpu", "cuda", "mps"]
"""Type of a device; auto is cuda if it is available, and cpu otherwise."""


class TrainedRun:
    """A trained run, for rendering and evaluation.

    Args:
        trained: model, settings and folder of the run.
    """

    def __init__(self, trained: Trained) -> None:
        self.model = trained.model
        """The trained model (`nerfloom.Model`), in evaluation mode."""
        self.run = trained.run
        """Method, settings, data format and folder of the run."""
        self._datasets: dict[Split, Dataset] = {}

    def __repr__(self) -> str:
        return f"TrainedRun({self.run.method!r}, {str(self.run.folder)!r}, {self.model.size():,} parameters)"

    def dataset(self, split: Split = "test") -> Dataset:
        """Return the images of a split, with their cameras. They are read once.

        Args:
            split: train, val or test.

        Raises:
            DataError: if the data cannot be read any more.
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
            time: time in [0, 1] of a moving scene; that of the view if None.

        Raises:
            ValueError: if there are several cameras.
        """
        if isinstance(camera, Cameras):
            if len(camera) != 1:
                raise ValueError(f"render() takes one camera, not {len(camera)}: choose one, as in cameras[0:1]")
            camera = View(camera.to(self.model.device), time)
        elif time is not None:
            camera = View(camera.camera, time, camera.rays_per_pixel, camera.stride)
        return self.model.render_view(camera, evaluation_background(self.model))

    def evaluate(
        self, split: Split = "test", max_images: int | None = None, lpips_weights: str | Path | None = None
    ) -> dict[str, Any]:
        """Return PSNR in dB, SSIM, at five scales too, LPIPS and rendering speed, by their names in eval.json.

        Args:
            split: the images to compare with: train, val or test.
            max_images: maximum number of images, evenly spread over the split; None for all.
            lpips_weights: file of LPIPS's weights; that of the run's settings if None.
        """
        weights = None if lpips_weights is None else Path(lpips_weights)
        return evaluate(self.model, self.dataset(split), max_images=max_images, lpips_weights=weights).results


def list_methods() -> dict[str, str]:
    """Return the summary of each method that can be trained, by name."""
    return {name: summary(entry) for name, entry in registered("methods").items()}


def load(run: str | Path, data: str | Path | None = None, device: Device = "auto") -> TrainedRun:
    """Load a trained run.

    Args:
        run: folder of the run, its config.yml, or a folder above it, whose newest run is taken.
        data: new location of the data, if it has been moved.
        device: device of the model.

    Raises:
        ConfigError: if config.yml is missing or invalid.
        CheckpointError: if the checkpoint is missing or does not fit the settings.
    """
    data_folder = None if data is None else Path(data)
    return TrainedRun(load_trained(config_file(Path(run)), device_type=device, data=data_folder))


def train(method: str, data: str | Path | None = None, format: str | None = None, **settings: Any) -> TrainedRun:
    """Train a method as `ns-train` does, and load the result.

    Args:
        method: name of the method; `list_methods()` lists all.
        data: folder of the data set; the embedded scene if None.
        format: name of the data format; detected if None.
        settings: settings of the method by name, with underscores, as in `max_seconds=60`.

    Raises:
        ConfigError: if the method or a setting is unknown.
        DataError: if the data cannot be used.
    """
    from nerfloom.cli.session import start

    folder, name = find_data(None if data is None else Path(data), format)
    config = from_plain(load_method(method).config, {**to_plain(settings), "data": _text(folder)}, "train()")
    config = limited_as_given(config, settings)
    run = Run(method, config, name, load_dataparser(name)(), run_folder(method, config))
    start(run)
    return load(run.folder, device=config.machine.device_type)


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)


def image(picture: Picture, what: str = "rgb") -> Image:
    """Return a component of a rendered image as a PIL image, which notebooks display.

    Args:
        picture: the rendered image, from `TrainedRun.render`.
        what: rgb for colour; depth for median depth, from dark (near) to light (far) over the depths of opaque pixels;
            accumulation for opacity; or the name of another output (`Picture.outputs`), such as normals.

    Raises:
        ValueError: if the picture has no such output.
    """
    from PIL import Image as images

    from nerfloom.evaluation.images import to_uint8
    from nerfloom.evaluation.panels import as_colors, depth_range, viridis

    if what == "rgb":
        shown = picture.rgb.clamp(0, 1)
    elif what == "depth":
        near, far = depth_range(picture.median_depth, picture.accumulation > 0.5)
        shown = viridis(((picture.median_depth - near) / max(far - near, 1e-9)).clamp(0, 1))
    elif what == "accumulation":
        shown = picture.accumulation.clamp(0, 1)[..., None].expand(-1, -1, 3)
    else:
        output = next((output for output in picture.outputs if output.name == what), None)
        if output is None:
            hint = "; train nerfacto with predict_normals=True" if what == "normals" else ""
            raise ValueError(f"this picture has no {what}{hint}")
        shown = as_colors(picture, output)[0]
    return images.fromarray(to_uint8(shown.cpu()))
