"""The Gaussians of a run or a file as a file, in the frame and units of the input."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.export.settings import SplatSettings
from nerfloom.geometry.regions import Region, inside_all
from nerfloom.splats.gaussians import Gaussians, HasGaussians
from nerfloom.splats.placed_files import capture_cameras, in_input, write_placed
from nerfloom.training.loaded import Loaded


def export_gaussians(loaded: Loaded, path: Path, settings: SplatSettings, regions: Sequence[Region] = ()) -> None:
    """Write the Gaussians of a run or a file, and report losses and how they are drawn.

    Args:
        loaded: the run or file.
        path: file to write, .ply, .spz, .sog or .glb; with `settings.num_frames`, NAME_0000.ply and so on beside it.
        settings: settings of the file.
        regions: Gaussians in all of these are kept, in the frame of exports.

    Raises:
        ConfigError: if there are no Gaussians, or a setting is out of range.
    """
    frames, model = settings.num_frames, loaded.model
    if settings.max_megabytes is not None and not settings.max_megabytes > 0:
        raise FlagError(f"--max-megabytes must be positive, not {settings.max_megabytes}")
    if frames is not None and frames < 1:
        raise FlagError(f"--num-frames is {frames}; it must be at least 1")
    if frames is not None and settings.time is not None:
        raise FlagError("--num-frames writes all times, and --time one; leave out one of them")
    if not isinstance(model, HasGaussians):
        raise ConfigError(
            f"ns-export gaussian-splat: {loaded.method} has no Gaussians; ns-train gaussian-splatting makes them"
        )
    if frames is None:
        _write(loaded, model, moment_of(model.scene.moving, settings.time), path, settings, regions)
        return
    if not model.scene.moving:
        raise ConfigError(f"--num-frames {frames}: the photographs of this run have no times")
    for index in range(frames):
        file = path.with_stem(f"{path.stem}_{index:04d}")
        _write(loaded, model, index / max(frames - 1, 1), file, settings, regions)


def moment_of(moving: bool, asked: float | None) -> float | None:
    """Return the time `asked` for, of photographs that have times if `moving`; None of a static scene.

    Raises:
        ConfigError: if a static scene was asked for a time.
        FlagError: if the time is not from 0 to 1.
    """
    if asked is not None and not moving:
        raise ConfigError(f"--time {asked:g}: the photographs of this run have no times")
    if asked is not None and not 0 <= asked <= 1:
        raise FlagError(f"--time is {asked:g}; it must be from 0 to 1")
    return (asked or 0.0) if moving else None


def finite(found: Gaussians, none_left: str) -> Gaussians:
    """Return the finite Gaussians of those `found`, on the CPU, and report the number of others.

    Args:
        found: Gaussians on any device, possibly with gradients.
        none_left: message of the error if there are none.

    Raises:
        ConfigError: if there are none.
    """
    found = found.map(lambda values: values.detach().cpu())
    good = found[found.finite()]
    if len(good) < len(found):
        say(f"{len(found) - len(good):,} of {len(found):,} Gaussians are not finite and are left out")
    if not len(good):
        raise ConfigError(none_left)
    return good


def _write(
    loaded: Loaded,
    model: HasGaussians,
    moment: float | None,
    path: Path,
    settings: SplatSettings,
    regions: Sequence[Region],
) -> None:
    """Write the Gaussians of a model at a moment, None of a static scene, to a file."""
    at = "" if moment is None else f" at time {moment:g}"
    good = finite(model.gaussians(moment), f"this run has no Gaussians left{at}; train it again")
    look, placement = model.look(), loaded.placement
    placed = in_input(good, placement)
    if regions:
        inside = inside_all(placed.means, regions)
        say(f"{int(inside.sum()):,} of {len(placed):,} Gaussians are in the region that is kept")
        placed = placed[inside]
    limit, version = settings.max_megabytes, settings.spz_version
    cameras = capture_cameras(loaded.model, placement)
    for sentence in write_placed(path, placed, look, loaded.scale, placement, limit, version, cameras):
        say(sentence)
    say(f"{path.stat().st_size / 1e6:.2f} MB, {look.words()}: {path}")
