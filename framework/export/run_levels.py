"""The Gaussians of a run or a file in a tree of levels of detail, in the frame and units of the input."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from nerfloom.base.console import say
from nerfloom.base.counts import counted
from nerfloom.base.errors import ConfigError
from nerfloom.cameras.camera_path import CameraPath
from nerfloom.cameras.kept_cameras import read_cameras, write_cameras
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.scale import Scale, read_scale, write_scale
from nerfloom.data.offsets import read_offset
from nerfloom.export.run_gaussians import moment_of
from nerfloom.export.settings import LevelsSettings
from nerfloom.geometry.regions import Region
from nerfloom.levels.building import build_levels
from nerfloom.levels.files import read_levels
from nerfloom.splats.files import stream_gaussians
from nerfloom.splats.gaussians import Gaussians, HasGaussianParts, HasGaussians
from nerfloom.splats.placed_files import capture_cameras, in_input
from nerfloom.splats.stream import GaussianStream
from nerfloom.training.loaded import Loaded


def export_levels(loaded: Loaded, path: Path, settings: LevelsSettings, regions: Sequence[Region] = ()) -> None:
    """Write the Gaussians of a run or a file to a file of levels, and report omissions.

    Args:
        loaded: the run or file.
        path: file to write, .levels.
        settings: settings of the file.
        regions: Gaussians in all of these are kept, in the frame of exports.

    Raises:
        ConfigError: if there are no Gaussians, or a setting is out of range.
        DataError: if no Gaussian is left.
        OSError: if the file cannot be written.
    """
    model = loaded.model
    if not isinstance(model, HasGaussians):
        raise ConfigError(f"ns-export levels: {loaded.method} has no Gaussians; ns-train gaussian-splatting makes them")
    moment, origin = moment_of(model.scene.moving, settings.time), torch.zeros(3, dtype=torch.float64)
    stream = GaussianStream(partial(_parts, model, moment, loaded.placement), model.look())
    cameras = capture_cameras(loaded.model, loaded.placement)
    _write(path, stream, origin, settings, regions, loaded.scale, cameras)


def _parts(model: HasGaussians, moment: float | None, placement: Placement, most: int) -> Iterator[Gaussians]:
    """Yield the Gaussians of a model at a moment in the frame of the input, on the CPU, at most `most` at a time."""
    whole: Iterable[Gaussians] = (
        model.gaussian_parts(moment) if isinstance(model, HasGaussianParts) else [model.gaussians(moment)]
    )
    for given in whole:
        for part in given.sliced(most):
            yield in_input(part.map(lambda values: values.detach().cpu()), placement)


def export_file_levels(file: Path, path: Path, settings: LevelsSettings, regions: Sequence[Region] = ()) -> None:
    """Write a file of Gaussians to a file of levels, and report omissions. The file is read part by part.

    Args:
        file: the file of Gaussians, in the frame of the input, or about a local origin given by an offset file beside
            it.
        path: file to write, .levels.
        settings: settings of the file.
        regions: Gaussians in all of these are kept, in the frame of the input.

    Raises:
        ConfigError: if a setting is out of range, or a package is missing that the format needs.
        DataError: if the file cannot be read, or no Gaussian is left.
        OSError: if the file cannot be written.
    """
    moment_of(False, settings.time)
    scale = read_scale(file)
    if scale.is_known:
        say(scale.words())
    _write(path, stream_gaussians(file), read_offset(file), settings, regions, scale, read_cameras(file))


def _write(
    path: Path,
    stream: GaussianStream,
    origin: Tensor,
    settings: LevelsSettings,
    regions: Sequence[Region],
    scale: Scale,
    cameras: CameraPath | None,
) -> None:
    kept = GaussianStream(_within(stream.parts, origin, regions), stream.look)
    left_out = build_levels(path, kept, origin, settings.chunk_size, settings.bits, settings.build_memory)
    if left_out:
        say(f"{left_out:,} Gaussians cannot be drawn and are left out")
    write_scale(path, scale)
    write_cameras(path, cameras)
    found = read_levels(path)
    size = path.stat().st_size / 1e6
    say(
        f"{size:.2f} MB, {counted(found.num_gaussians, 'Gaussians')} in {counted(len(found.nodes), 'chunks')}, "
        f"{found.look.words()}: {path}"
    )


def _within(
    parts: Callable[[int], Iterator[Gaussians]], origin: Tensor, regions: Sequence[Region]
) -> Callable[[int], Iterator[Gaussians]]:
    """Return a function that yields the Gaussians of `parts` without those outside of a region."""

    def kept(most: int) -> Iterator[Gaussians]:
        for part in parts(most):
            centers = part.means.double() + origin
            for region in regions:
                inside = region.contains(centers)
                part, centers = part[inside], centers[inside]
            yield part

    return kept
