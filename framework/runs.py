"""Functions for notebooks and scripts: train a method, load a run, show an image."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from nerfloom.base.plain import from_plain, to_plain
from nerfloom.base.step_limit import limited_as_given
from nerfloom.registry import load_dataparser, load_method, registered, summary
from nerfloom.rendering.rendered import Picture
from nerfloom.training.data_folder import find_data
from nerfloom.training.load import load as opened
from nerfloom.training.loaded import Loaded
from nerfloom.training.run import Run, run_folder
from nerfloom.training.run_path import config_file

if TYPE_CHECKING:
    from PIL.Image import Image

Device = Literal["auto", "cpu", "cuda", "mps"]
"""Type of a device. auto: cuda if available, else cpu."""


def list_methods() -> dict[str, str]:
    """Return the summary of each method that can be trained, by name."""
    return {name: summary(entry) for name, entry in registered("methods").items()}


def load(path: str | Path, data: str | Path | None = None, device: Device = "auto") -> Loaded:
    """Load a trained run, a scene in blocks, a file of Gaussians, or an octree.

    Args:
        path: folder of the run, its config.yml, a folder above it (for its newest run), a blocks.yml or its folder, a
            file of Gaussians (.ply, .spz, .sog, .splat, .ksplat), or an octree (.octree).
        data: new location of the run's data, if it has moved; optional data for a file.
        device: device of the model.

    Raises:
        ConfigError: if config.yml is missing or invalid.
        CheckpointError: if the checkpoint is missing or does not fit the settings.
        DataError: if the file cannot be read.
    """
    return opened(config_file(Path(path)), device_type=device, data=None if data is None else Path(data))


def train(method: str, data: str | Path | None = None, format: str | None = None, **settings: Any) -> Loaded:
    """Train a method as `ns-train` does, and load the result.

    Args:
        method: name of the method; `list_methods()` lists all.
        data: folder of the data set; None for the embedded scene.
        format: name of the data format; None to detect it.
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
    """Return an output of a rendered image as a PIL image, which notebooks display.

    Args:
        picture: the rendered image, from `Loaded.render`.
        what: rgb for colour; depth for median depth, from dark (near) to light (far) over the depths of opaque pixels;
            accumulation for opacity; or another output's name (`Picture.outputs`), such as normals.

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
