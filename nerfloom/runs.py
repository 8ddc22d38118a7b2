"""Train a method, load what was trained, look at it and judge it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from framework.base.config import from_plain, to_plain
from framework.base.registry import load_dataparser, load_method, registered, summary
from framework.base.splits import Split
from framework.cameras.cameras import Cameras
from framework.cameras.view import View
from framework.data.data_folder import find_data
from framework.data.dataset import Dataset
from framework.evaluation.evaluator import evaluate, evaluation_background
from framework.rendering.rendered import Picture
from framework.training.datasets import load_split
from framework.training.run import Run, config_file, run_folder
from framework.training.trained import Trained, load_trained

if TYPE_CHECKING:
    from PIL.Image import Image

Device = Literal["auto", "cpu", "cuda", "mps"]


class TrainedRun:
    """A trained run, ready to be rendered and judged.

    Args:
        trained: the run's model, settings and folder.
    """

    def __init__(self, trained: Trained) -> None:
        self.model = trained.model
        """What was learnt, in evaluation mode (`framework.Model`)."""
        self.run = trained.run
        """The method, its settings, the data format and the folder."""
        self._datasets: dict[Split, Dataset] = {}

    def __repr__(self) -> str:
        return f"TrainedRun({self.run.method!r}, {str(self.run.folder)!r}, {self.model.size():,} parameters)"

    def dataset(self, split: Split = "test") -> Dataset:
        """Return the images of a split, with their cameras; read once.

        Args:
            split: train, val or test.
        Raises: DataError where the data is not there any more.
        """
        if split not in self._datasets:
            self._datasets[split] = load_split(self.run, split).to(self.model.device)
        return self._datasets[split]

    def views(self, split: Split = "test") -> list[View]:
        """Return the cameras of a split's images, one each.

        Args:
            split: train, val or test.
        """
        dataset = self.dataset(split)
        return [dataset.view(index) for index in range(len(dataset))]

    def render(self, camera: View | Cameras, time: float | None = None) -> Picture:
        """Return what a camera sees: `rgb`, `depth`, `accumulation` and more.

        Args:
            camera: a view, or one camera.
            time: in [0, 1], of a scene that moves; that of the view if None.
        Raises: ValueError for several cameras.
        """
        if isinstance(camera, Cameras):
            if len(camera) != 1:
                raise ValueError(f"render() takes one camera, not {len(camera)}: choose one, as in cameras[0:1]")
            camera = View(camera.to(self.model.device), time)
        elif time is not None:
            camera = View(camera.camera, time, camera.rays_per_pixel, camera.stride)
        return self.model.render_view(camera, evaluation_background(self.model))

    def evaluate(self, split: Split = "test", max_images: int | None = None) -> dict[str, Any]:
        """Return PSNR in dB, SSIM, LPIPS and speed, by the names that eval.json has.

        Args:
            split: which images to judge by.
            max_images: at most this many, evenly spread; all if None.
        """
        return evaluate(self.model, self.dataset(split), max_images=max_images).results


def methods() -> dict[str, str]:
    """Return the methods that can be trained: name and summary."""
    return {name: summary(entry) for name, entry in registered("methods").items()}


def load(run: str | Path, data: str | Path | None = None, device: Device = "auto") -> TrainedRun:
    """Load a trained run.

    Args:
        run: its folder, or its config.yml.
        data: where its data is now, if that has moved.
        device: where to render.
    Raises: ConfigError or CheckpointError where something is missing or does not fit.
    """
    moved = None if data is None else Path(data)
    return TrainedRun(load_trained(config_file(Path(run)), device_type=device, data=moved))


def train(method: str, data: str | Path | None = None, format: str | None = None, **settings: Any) -> TrainedRun:
    """Train a method as `ns-train` does, and load the result.

    Args:
        method: its name; `methods()` lists them.
        data: folder of the data set; the embedded scene if None.
        format: name of the data format; recognised if None.
        settings: the method's flags by their names, with underscores, as in `max_seconds=60`.
    Raises: ConfigError for an unknown method or setting; DataError for data that cannot be used.
    """
    from framework.cli.session import start

    folder, name = find_data(None if data is None else Path(data), format)
    config = from_plain(load_method(method).config, {**to_plain(settings), "data": _text(folder)}, "train()")
    run = Run(method, config, name, load_dataparser(name)(), run_folder(method, config))
    start(run)
    return load(run.folder, device=config.machine.device_type)


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)


def image(picture: Picture, what: Literal["rgb", "depth", "accumulation", "normals"] = "rgb") -> Image:
    """Return a part of a picture as an image that notebooks show by themselves.

    Args:
        picture: from `TrainedRun.render`.
        what: colours; or depth, from dark (near) to light (far) over the depths of what is opaque; or opacity; or
            normals, red, green and blue being x, y and z from -1 to 1.
    Raises: ValueError for normals that the method does not have.
    """
    from PIL import Image as images

    from framework.evaluation.images import to_uint8
    from framework.evaluation.panels import depth_range, viridis

    if what == "rgb":
        shown = picture.rgb.clamp(0, 1)
    elif what == "depth":
        near, far = depth_range(picture.median_depth, picture.accumulation > 0.5)
        shown = viridis(((picture.median_depth - near) / max(far - near, 1e-9)).clamp(0, 1))
    elif what == "accumulation":
        shown = picture.accumulation.clamp(0, 1)[..., None].expand(-1, -1, 3)
    elif picture.normals is not None:
        shown = (picture.normals + 1) / 2
    else:
        raise ValueError("this method has no normals; train nerfacto with predict_normals=True")
    return images.fromarray(to_uint8(shown.cpu()))
