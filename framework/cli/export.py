"""The command `ns-export`: point clouds and cameras of a trained run, in the frame and units of its input."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from framework.base.errors import ConfigError
from framework.cli.common import chosen_kind, make_room, run_command, with_run

if TYPE_CHECKING:
    from framework.cameras.poses import Placement
    from framework.training.trained import Trained

USAGE = """\
usage: ns-export WHAT RUN_FOLDER --output-dir DIR [flags]

  pointcloud      point_cloud.ply: points on surfaces, with colours, and normals if the method has them
  gaussian-splat  splat.ply or splat.spz: the Gaussians of a method that has them, for viewers
  cameras         transforms_train.json: the training cameras, with refined poses if the run has refined them
  web             scene.html: one file that shows the scene in any browser with WebGL 2, from disk, offline

ns-export WHAT --help shows its flags. Everything is written in the frame and units of the run's input.
"""


@dataclass(frozen=True)
class ExportFlags:
    """Flags of every export."""

    load_config: Path
    """Folder of the run, or its config.yml; the flag's name may be omitted."""
    output_dir: Path
    """Folder to write to."""
    load_checkpoint: Path | None = None
    """Checkpoint to load; the newest if not given."""
    data: Path | None = None
    """Folder of the data, if it has moved since training."""
    device_type: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    """Device to render on."""


@dataclass(frozen=True)
class PointFlags(ExportFlags):
    """Write point_cloud.ply: points at the median depth of random training rays."""

    num_points: int = 1_000_000
    """Number of rays; rays that end on no surface, or too far away, give no point."""
    reach: float = 2.0
    """Maximum distance of a point from the box's centre along each axis, in half edges of the box; 0 keeps all."""


@dataclass(frozen=True)
class CameraFlags(ExportFlags):
    """Write transforms_train.json: names and camera-to-world matrices of the training images."""


@dataclass(frozen=True)
class SplatFlags(ExportFlags):
    """Write splat.ply or splat.spz: Gaussians, as the code of 3D Gaussian Splatting and viewers read them."""

    format: Literal["ply", "spz"] = "ply"
    """ply: 32 bits a number, read by every program. spz: 8 to 24 bits, compressed; about a tenth of the size."""
    max_megabytes: float | None = None
    """Make the file at most this large, in millions of bytes: fewer harmonics first, fewer Gaussians last."""


@dataclass(frozen=True)
class WebFlags(ExportFlags):
    """Write scene.html: a page that shows the scene's Gaussians, or such as are fitted to the pictures of a field."""

    max_megabytes: float = 30.0
    """Maximum size of the page in millions of bytes, up to 32: fewer harmonics first, fewer Gaussians last."""
    fit_seconds: float = 60.0
    """Seconds for fitting Gaussians to a field: rendering pictures of it, and training on them."""
    time: float | None = None
    """Moment that is shown of a scene that moves, 0 to 1; 0 if not given."""


def main() -> None:
    """Run ns-export on the arguments of the process."""
    run_command(_command)


def _command(arguments: list[str]) -> None:
    if (chosen := chosen_kind(arguments, KINDS, USAGE, "nothing is exported as")) is None:
        return
    import tyro

    name, (kind, file, run), rest = chosen
    flags = tyro.cli(kind, prog=f"ns-export {name}", args=with_run(rest), config=(tyro.conf.FlagConversionOff,))
    from framework.training.trained import load_trained

    path = flags.output_dir / file.format_map(vars(flags))
    make_room(path)
    trained = load_trained(flags.load_config, flags.load_checkpoint, flags.device_type, flags.data)
    if trained.model.scene.warped:
        raise ConfigError("this run is in normalised device coordinates (--ndc), which have no scale to export")
    run(flags, trained, _placement(trained), path)


def _placement(trained: Trained) -> Placement:
    """Return the placement of the input in the run's scene."""
    from framework.cameras.poses import Placement

    return Placement(trained.content["transform"].double().cpu(), float(trained.content["scale"]))


def _points(flags: PointFlags, trained: Trained, placement: Placement, path: Path) -> None:
    if flags.num_points < 1 or not flags.reach >= 0:
        raise ConfigError("--num-points must be at least 1, and --reach at least 0")
    from framework.base.console import say, track
    from framework.base.device import seed_step
    from framework.data.ply import write_points
    from framework.export.points import joined, surface_points
    from framework.ray_model import RayModel
    from framework.training.datasets import load_split

    model = trained.model
    if not isinstance(model, RayModel):
        raise ConfigError(f"ns-export pointcloud: {trained.run.method} casts no rays, which end in surfaces")
    dataset = load_split(trained.run, "train").to(model.device)
    seed_step(trained.run.config.machine.seed, 0)
    chunks = -(-flags.num_points // model.config.eval_num_rays_per_chunk)
    parts = surface_points(model, dataset, flags.num_points, flags.reach or None)
    found = joined(track(parts, "Looking for surfaces", total=chunks))
    if not len(found.positions):
        raise ConfigError("no training ray ends in a surface inside --reach; is the run trained? --reach 0 keeps all")
    positions = placement.original_points(found.positions.double()).float()
    normals = None if found.normals is None else placement.original_directions(found.normals.double()).float()
    write_points(path, positions, found.colors, normals)
    say(f"{len(positions):,} points: {path}")


def _cameras(flags: CameraFlags, trained: Trained, placement: Placement, path: Path) -> None:
    from framework.base.console import say
    from framework.export.cameras import camera_list, refined_cameras
    from framework.training.datasets import load_split
    from framework.training.run import write_json

    # Load the images too: cameras of unreadable images are not in the model.
    dataset = load_split(trained.run, "train").to(trained.model.device)
    cameras = refined_cameras(trained.model, dataset.cameras)
    write_json(path, camera_list(cameras, dataset.names, placement))
    say(f"{len(cameras)} cameras: {path}")


def _splats(flags: SplatFlags, trained: Trained, placement: Placement, path: Path) -> None:
    if flags.max_megabytes is not None and not flags.max_megabytes > 0:
        raise ConfigError(f"--max-megabytes must be positive, not {flags.max_megabytes}")
    from framework.base.console import say
    from framework.splats.files import write_gaussians
    from framework.splats.gaussians import HasGaussians
    from framework.splats.transform import transformed

    if not isinstance(trained.model, HasGaussians):
        raise ConfigError(
            f"ns-export gaussian-splat: {trained.run.method} has no Gaussians; ns-train gaussian-splatting makes them"
        )
    found = trained.model.gaussians().map(lambda values: values.detach().cpu())
    good = found[found.finite()]
    if len(good) < len(found):
        say(f"{len(found) - len(good):,} of {len(found):,} Gaussians are not finite and are left out")
    if not len(good):
        raise ConfigError("this run has no Gaussians left; train it again")
    for cost in write_gaussians(path, transformed(good, *placement.original_similarity()), flags.max_megabytes):
        say(cost)
    say(f"{path.stat().st_size / 1e6:.2f} MB: {path}")


def _web(flags: WebFlags, trained: Trained, placement: Placement, path: Path) -> None:
    from framework.export.run_page import export_page

    export_page(trained, path, flags.max_megabytes, flags.fit_seconds, flags.time)


KINDS: dict[str, tuple[type[Any], str, Any]] = {
    "pointcloud": (PointFlags, "point_cloud.ply", _points),
    "gaussian-splat": (SplatFlags, "splat.{format}", _splats),
    "cameras": (CameraFlags, "transforms_train.json", _cameras),
    "web": (WebFlags, "scene.html", _web),
}

if __name__ == "__main__":
    main()
