"""Functions for notebooks and scripts: find poses of photographs, train a method, load a run, show an image."""

from __future__ import annotations

import os
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from nerfloom.base.arguments import arguments_of
from nerfloom.base.errors import ConfigError, nearest, shown
from nerfloom.base.plain import from_plain
from nerfloom.base.step_limit import limited_as_given
from nerfloom.opened import Opened
from nerfloom.registry import load_dataparser, load_method, registered, summary
from nerfloom.rendering.rendered import Picture
from nerfloom.splats.placement import Axis
from nerfloom.training.data_folder import find_data
from nerfloom.training.load import load as loaded
from nerfloom.training.run import Run, run_folder
from nerfloom.training.run_path import config_file

if TYPE_CHECKING:
    from PIL.Image import Image

Device = Literal["auto", "cpu", "cuda", "mps"]
"""Type of a device. auto: cuda if available, else cpu."""


def list_methods() -> dict[str, str]:
    """Return the summary of each method that can be trained, by name."""
    return {name: summary(entry) for name, entry in registered("methods").items()}


def load(
    path: str | Path,
    data: str | Path | None = None,
    device: Device = "auto",
    up: Axis | None = None,
    checkpoint: str | Path | None = None,
) -> Opened:
    """Load a trained run, a scene in blocks, a file of Gaussians or of levels, or an octree.

    Args:
        path: folder of the run, its config.yml, a folder above it (for its newest run), a blocks.yml or its folder, a
            file of Gaussians (.ply, .spz, .sog, .splat, .ksplat) or of levels (.levels), or an octree (.octree).
        data: new location of the run's data, if it has moved; optional data for a file.
        device: device of the model.
        up: up axis of a file of Gaussians without data: x, y, z, -x, -y or -z; None for z.
        checkpoint: checkpoint of the run; None for the newest readable one.

    Raises:
        ConfigError: if config.yml is missing or invalid, or `up` or `checkpoint` does not suit the run or file.
        CheckpointError: if the checkpoint is missing or does not fit the settings.
        DataError: if the file cannot be read.
    """
    if up not in (None, *get_args(Axis)):
        raise ConfigError(f"up is {shown(up)}; it must be one of {', '.join(get_args(Axis))}")
    found = config_file(_at_home(path))
    return Opened.of(loaded(found, _path(checkpoint), device, _path(data), up=up))


def process(photographs: str | Path, output_dir: str | Path, kind: str = "images", **settings: Any) -> Path:
    """Find the poses of photographs, as `ns-process-data` does, and return the data folder.

    Args:
        photographs: folder of photographs, a video, or the export of a phone's app or of another program.
        output_dir: folder to write; new or empty.
        kind: images, video (each takes the other's input, too), polycam, record3d, metashape, realitycapture, odm,
            bundler or aria.
        settings: flags of `ns-process-data` by name, with underscores, as in `matching_method="sequential"`.

    Raises:
        ConfigError: if the kind or a setting is unknown or out of range, or COLMAP is missing.
        DataError: if the photographs cannot be used.
    """
    from nerfloom.processing.kinds import KINDS
    from nerfloom.processing.kinds import process as processed
    from nerfloom.processing.listing import kind_of

    if kind not in KINDS:
        raise ConfigError(f"unknown kind '{kind}'. {nearest(kind, list(KINDS))}")
    kind, data = kind_of(kind, _at_home(photographs))
    flags = KINDS[kind].flags
    output = _at_home(output_dir)
    given = {**settings, "data": data, "output_dir": output}
    processed(kind, flags(**arguments_of(flags, given, "process()")))
    return output


def train(method: str, data: str | Path | None = None, format: str | None = None, **settings: Any) -> Opened:
    """Train a method as `ns-train` does, and load the result.

    Args:
        method: name of the method; `list_methods()` lists all.
        data: folder of the data set; None for the embedded scene.
        format: name of the data format; None to detect it.
        settings: settings of the method and of the data format by name, with underscores, as in
            `max_seconds=60, downscale_factor=2`.

    Raises:
        ConfigError: if the method or a setting is unknown.
        DataError: if the data cannot be used.
    """
    from nerfloom.cli.session import start

    folder, name = find_data(_path(data), format)
    parser = load_dataparser(name)()
    of_format = settings.keys() & {field.name for field in fields(parser)}  # type: ignore[arg-type]
    parser = from_plain(parser, {key: settings.pop(key) for key in of_format}, "train()")
    config = from_plain(load_method(method).config, {**settings, "data": _text(folder)}, "train()")
    config = limited_as_given(config, settings)
    run = Run(method, config, name, parser, run_folder(method, config))
    return load(start(run).folder, device=config.machine.device_type)


def _path(given: str | Path | None) -> Path | None:
    return None if given is None else _at_home(given)


def _at_home(given: str | Path) -> Path:
    return Path(os.path.expanduser(given))


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
