"""The command `ns-export`: points, meshes, Gaussians, pages and more, in the frame and units of the input."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, DataError, FlagError
from nerfloom.base.extras import install_command
from nerfloom.cli.common import chosen_kind, make_room, run_command, with_format, with_run
from nerfloom.cli.export_flags import ExportFlags
from nerfloom.cli.export_mesh import MarchingCubesFlags, TsdfFlags, marching_cubes, tsdf
from nerfloom.cli.flags import read_flags
from nerfloom.cli.region_flags import RegionFlags
from nerfloom.cli.run_flags import OPENS

if TYPE_CHECKING:
    from nerfloom.data.parsed_scene import ParsedScene
    from nerfloom.splats.gaussians import HasGaussians
    from nerfloom.training.loaded import Loaded

USAGE = """\
usage: ns-export WHAT RUN_FOLDER --output-dir DIR [flags]

  tsdf            mesh.ply, .obj or .glb: a mesh of what the training cameras see; for captures, and every method
  marching-cubes  mesh.ply, .obj or .glb: a mesh of where a field is dense; for objects, closed; not of Gaussians
  pointcloud      point_cloud.ply: points on surfaces, with colours and normals
  gaussian-splat  splat.ply, .spz, .sog or .glb: the Gaussians of a run, for other programs
  web             scene.html: one file that shows the scene in any browser with WebGL 2, from disk, offline
  cameras         nerfstudio/transforms.json and colmap/sparse/0: the cameras of all photographs, refined if the run
                  refined them; transforms_train.json: the training cameras, in nerfstudio's format
  occupancy       occupancy.npz and occupancy.ply: the cells that the method samples, if it has a grid

  ns-export tsdf RUN_FOLDER --output-dir exports

Instead of a run, pass a file of Gaussians (.ply, .spz, .sog, .splat, .ksplat): gaussian-splat and web need no data,
others --data DIR.

  ns-export web splat.ply --output-dir exports

ns-export WHAT --help shows its flags. All files use the frame and units of the input, or the unit that ns-measure
has set. In .glb files, y is up.
"""


@dataclass(frozen=True, kw_only=True)
class PointFlags(RegionFlags, ExportFlags):
    """Write point_cloud.ply: points at the median depth of random training rays."""

    num_points: int = 1_000_000
    """Number of rays; rays without a surface, or with one beyond --reach, give no point."""
    reach: float = 2.0
    """Maximum distance of a point from the box's centre along each axis, in half edges of the box; 0: no limit."""
    remove_outliers: bool = True
    """Remove points that are farther from their 20 nearest neighbours than --std-ratio allows."""
    std_ratio: float = 2.0
    """Distance of an outlier from its neighbours, in standard deviations above the mean over all points."""
    estimate_normals: bool = True
    """Estimate normals from each point's neighbours if the method has none."""


@dataclass(frozen=True, kw_only=True)
class CameraFlags(ExportFlags):
    """Write cameras as nerfstudio/transforms.json, colmap/sparse/0/*.txt, and transforms_train.json."""

    relative_paths: bool = False
    """Write image paths relative to transforms.json instead of absolute paths."""


@dataclass(frozen=True, kw_only=True)
class OccupancyFlags(ExportFlags):
    """Write occupancy.npz, the occupancy grid, and occupancy.ply, its occupied cells."""

    cells: Literal["centers", "boxes"] = "centers"
    """Content of occupancy.ply: the cells' centres, or the surface of their boxes."""


@dataclass(frozen=True, kw_only=True)
class SplatFlags(RegionFlags, ExportFlags):
    """Write splat.ply, .spz, .sog or .glb: Gaussians for viewers and the code of 3D Gaussian Splatting."""

    format: Literal["ply", "spz", "sog", "glb"] = "ply"
    """ply: 32 bits per number, supported by every program; spz: 8 to 24 bits, compressed to about a tenth; sog: images
    in a zip file, for PlayCanvas; glb: glTF with KHR_gaussian_splatting, y up."""
    spz_version: Literal[2, 3, 4] = 2
    """Version of spz files. 2: read by most programs; 3: finer rotations; 4: newest, needs the package zstandard."""
    max_megabytes: float | None = None
    """Maximum file size, MB (1e6 bytes). Harmonics are reduced first, Gaussians last. Default: no limit."""
    time: float | None = None
    """Time of a moving scene, 0 to 1. Default: 0."""
    num_frames: int | None = None
    """Write this many files of a moving scene, at times evenly spaced from 0 to 1: splat_0000.ply and so on. Default:
    one file."""


@dataclass(frozen=True, kw_only=True)
class WebFlags(RegionFlags, ExportFlags):
    """Write scene.html: a page that shows the scene's Gaussians, or Gaussians fitted to pictures of a field."""

    max_megabytes: float = 30.0
    """Maximum size of the page, MB (1e6 bytes), up to 32. Harmonics are reduced first, Gaussians last."""
    fit_seconds: float = 60.0
    """Seconds for fitting Gaussians to a field: rendering pictures of it and training on them."""
    time: float | None = None
    """Time of a moving scene, 0 to 1. Default: 0."""


def main() -> None:
    """Run ns-export on the arguments of the process."""
    run_command(_command)


def _command(arguments: list[str]) -> None:
    if (chosen := chosen_kind(arguments, KINDS, USAGE, "nothing is exported as")) is None:
        return
    name, (kind, file, run), rest = chosen
    words, named = with_format(f"ns-export {name}", with_run(rest))
    flags = read_flags(kind, f"ns-export {name}", words, takes=OPENS)
    found = flags.check()
    path = flags.output_dir / file.format_map(vars(flags))
    make_room(path)
    loaded = flags.load(found, named)
    if loaded.model.scene.warped:
        raise ConfigError("this run is in normalised device coordinates (--ndc), which have no scale to export")
    if loaded.scale.is_known:
        say(loaded.scale.words())
    run(flags, loaded, path)


def _points(flags: PointFlags, loaded: Loaded, path: Path) -> None:
    if flags.num_points < 1 or not flags.reach >= 0 or not flags.std_ratio >= 0:
        raise FlagError("--num-points must be at least 1, --reach and --std-ratio at least 0")
    if flags.remove_outliers or flags.estimate_normals:
        _need_packages("--remove-outliers and --estimate-normals need", "; or set both to False")
    from nerfloom.base.console import track
    from nerfloom.base.device import seed_step
    from nerfloom.data.ply import write_points
    from nerfloom.export.neighbors import inliers, plane_normals
    from nerfloom.export.points import joined, num_views, picture_points, surface_points
    from nerfloom.geometry.regions import inside_all
    from nerfloom.renderable import RendersRays

    model, dataset = loaded.model, loaded.dataset("train")
    seed_step(loaded.run.config.machine.seed, 0)
    if isinstance(model, RendersRays):
        chunks = -(-flags.num_points // model.rays_at_once)
        parts = surface_points(model, dataset, flags.num_points, flags.reach or None)
    else:
        chunks = num_views(dataset)
        parts = picture_points(model, dataset, flags.num_points, flags.reach or None)
    found = joined(track(parts, "Looking for surfaces", total=chunks))
    if not len(found.positions):
        raise ConfigError("no training ray ends in a surface inside --reach; is the run trained? --reach 0 keeps all")
    if regions := flags.regions():
        found = found[inside_all(loaded.placement.original_points(found.positions), regions)]
    if flags.remove_outliers:
        kept = inliers(found.positions, flags.std_ratio)
        say(f"{len(kept) - int(kept.sum()):,} of {len(kept):,} points are outliers and left out (--remove-outliers)")
        found = found[kept]
    normals = found.normals
    if normals is None and flags.estimate_normals:
        normals = plane_normals(found.positions, -found.directions)
    positions = loaded.placement.original_points(found.positions)
    normals = None if normals is None else loaded.placement.original_directions(normals).float()
    write_points(path, positions, found.colors, normals)
    say(f"{len(positions):,} points: {path}")


def _need_packages(what: str, otherwise: str = "") -> None:
    """Raise ConfigError if a package of the extra `export` is missing."""
    if (advice := install_command("export")) is not None:
        raise ConfigError(f"{what} packages that are not installed: {advice}{otherwise}")


def _cameras(flags: CameraFlags, loaded: Loaded, path: Path) -> None:
    from nerfloom.export.cameras import SPLITS, camera_list, posed_files
    from nerfloom.export.colmap_text import images_folder, write_model
    from nerfloom.export.transforms import write_transforms
    from nerfloom.training.run import write_json

    # Load the images too: cameras of unreadable images are not in the model.
    dataset = loaded.dataset("train")
    write_json(path, camera_list(dataset.cameras, dataset.names, loaded.placement))
    say(f"{len(dataset)} training cameras: {path}")
    scenes: dict[str, ParsedScene] = {}
    for split in SPLITS:
        try:
            scenes[split] = loaded.parsed(split)
        except DataError as error:
            say(f"no '{split}' cameras: {error}")
    posed = posed_files(scenes, loaded.placement)
    file = path.parent / "nerfstudio" / "transforms.json"
    write_transforms(file, posed, flags.relative_paths)
    counts = ", ".join(f"{len(members)} {split}" for split, members in posed.splits.items())
    say(f"{len(posed.files)} cameras ({counts}): {file}; train on it: ns-train METHOD --data {file.parent}")
    model = path.parent / "colmap" / "sparse" / "0"
    try:
        write_model(model, posed)
    except ConfigError as error:
        say(f"no COLMAP model: {error}")
    else:
        say(f"COLMAP model: {model}; its images are in {images_folder(posed)}")


def _occupancy(flags: OccupancyFlags, loaded: Loaded, path: Path) -> None:
    from nerfloom.export.occupancy import write_cells, write_grid
    from nerfloom.renderable import parts
    from nerfloom.samplers.base import SkipsCells

    grids = parts(loaded.model, SkipsCells)
    if not grids:
        raise ConfigError(f"ns-export occupancy: this run of {loaded.method} has no occupancy grid")
    if flags.cells == "boxes":
        _need_packages("--cells boxes needs", "; or take --cells centers")
    grid = grids[0]
    count = int(grid.occupied_when()[: grid.resolution**3].sum())
    write_grid(path, grid, loaded.placement)
    say(f"{grid.resolution}^3 cells, {count:,} occupied: {path}")
    if not count:
        raise ConfigError("no cell is occupied, so that there is nothing to write to occupancy.ply")
    cells = path.with_suffix(".ply")
    write_cells(cells, grid, loaded.placement, flags.cells == "boxes")
    say(f"{count:,} cells: {cells}")


def _splats(flags: SplatFlags, loaded: Loaded, path: Path) -> None:
    if flags.max_megabytes is not None and not flags.max_megabytes > 0:
        raise FlagError(f"--max-megabytes must be positive, not {flags.max_megabytes}")
    if flags.num_frames is not None and flags.num_frames < 1:
        raise FlagError(f"--num-frames is {flags.num_frames}; it must be at least 1")
    if flags.num_frames is not None and flags.time is not None:
        raise FlagError("--num-frames writes all times, and --time one; leave out one of them")
    from nerfloom.export.run_page import moment_of
    from nerfloom.splats.gaussians import HasGaussians

    model = loaded.model
    if not isinstance(model, HasGaussians):
        raise ConfigError(
            f"ns-export gaussian-splat: {loaded.method} has no Gaussians; ns-train gaussian-splatting makes them"
        )
    if flags.num_frames is None:
        _write_splats(flags, loaded, model, moment_of(model.scene.moving, flags.time), path)
        return
    if not model.scene.moving:
        raise ConfigError(f"--num-frames {flags.num_frames}: the photographs of this run have no times")
    for index in range(flags.num_frames):
        time = index / max(flags.num_frames - 1, 1)
        _write_splats(flags, loaded, model, time, path.with_stem(f"{path.stem}_{index:04d}"))


def _write_splats(flags: SplatFlags, loaded: Loaded, model: HasGaussians, moment: float | None, path: Path) -> None:
    """Write the Gaussians of a model at a moment, None of a static scene, to a file."""
    from nerfloom.geometry.regions import inside_all
    from nerfloom.splats.placed_files import in_input, write_placed

    found = model.gaussians(moment).map(lambda values: values.detach().cpu())
    good = found[found.finite()]
    if len(good) < len(found):
        say(f"{len(found) - len(good):,} of {len(found):,} Gaussians are not finite and are left out")
    if not len(good):
        at = "" if moment is None else f" at time {moment:g}"
        raise ConfigError(f"this run has no Gaussians left{at}; train it again")
    look, placement = model.look(), loaded.placement
    placed = in_input(good, placement)
    if regions := flags.regions():
        placed = placed[inside_all(placed.means, regions)]
    for sentence in write_placed(path, placed, look, loaded.scale, placement, flags.max_megabytes, flags.spz_version):
        say(sentence)
    say(f"{path.stat().st_size / 1e6:.2f} MB, {look.words()}: {path}")


def _web(flags: WebFlags, loaded: Loaded, path: Path) -> None:
    from nerfloom.export.run_page import export_page
    from nerfloom.registry import load_method

    splatting = load_method("gaussian-splatting")
    export_page(loaded, path, flags.max_megabytes, flags.fit_seconds, flags.time, splatting, flags.regions())


KINDS: dict[str, tuple[type[Any], str, Any]] = {
    "pointcloud": (PointFlags, "point_cloud.ply", _points),
    "marching-cubes": (MarchingCubesFlags, "mesh.{format}", marching_cubes),
    "tsdf": (TsdfFlags, "mesh.{format}", tsdf),
    "gaussian-splat": (SplatFlags, "splat.{format}", _splats),
    "cameras": (CameraFlags, "transforms_train.json", _cameras),
    "occupancy": (OccupancyFlags, "occupancy.npz", _occupancy),
    "web": (WebFlags, "scene.html", _web),
}

if __name__ == "__main__":
    main()
