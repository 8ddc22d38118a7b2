"""The Gaussians of a run or a file as a file, in the frame and units of the input."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.export.run_page import moment_of
from nerfloom.export.settings import SplatSettings
from nerfloom.geometry.regions import Region, inside_all
from nerfloom.splats.gaussians import HasGaussians
from nerfloom.splats.placed_files import in_input, write_placed
from nerfloom.training.loaded import Loaded


def export_gaussians(loaded: Loaded, path: Path, settings: SplatSettings, regions: Sequence[Region] = ()) -> None:
    """Write the Gaussians of a run or a file, and say what was lost and how they are drawn.

    Args:
        loaded: the run or file.
        path: file to write, .ply or .spz.
        settings: settings of the file.
        regions: Gaussians in all of these are kept, in the frame of exports.

    Raises:
        ConfigError: if there are no Gaussians, or a setting is out of range.
    """
    if settings.max_megabytes is not None and not settings.max_megabytes > 0:
        raise FlagError(f"--max-megabytes must be positive, not {settings.max_megabytes}")
    if not isinstance(loaded.model, HasGaussians):
        raise ConfigError(
            f"ns-export gaussian-splat: {loaded.method} has no Gaussians; ns-train gaussian-splatting makes them"
        )
    moment = moment_of(loaded.model.scene.moving, settings.time)
    found = loaded.model.gaussians(moment).map(lambda values: values.detach().cpu())
    good = found[found.finite()]
    if len(good) < len(found):
        say(f"{len(found) - len(good):,} of {len(found):,} Gaussians are not finite and are left out")
    if not len(good):
        raise ConfigError("this run has no Gaussians left; train it again")
    look = loaded.model.look()
    placed = in_input(good, loaded.placement)
    if regions:
        placed = placed[inside_all(placed.means, regions)]
    for sentence in write_placed(path, placed, look, loaded.scale, settings.max_megabytes):
        say(sentence)
    say(f"{path.stat().st_size / 1e6:.2f} MB, {look.words()}: {path}")
