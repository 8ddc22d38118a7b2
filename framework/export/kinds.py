"""Exports by name, in the frame and units of the input, for `ns-export` and `run.export`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, NamedTuple

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, nearest
from nerfloom.export.settings import (
    CameraSettings,
    LevelsSettings,
    MarchingCubesSettings,
    OccupancySettings,
    PointSettings,
    SplatSettings,
    TsdfSettings,
    WebSettings,
)

if TYPE_CHECKING:
    from nerfloom.geometry.regions import Region
    from nerfloom.training.loaded import Loaded

MESHES = (".ply", ".obj", ".glb")
"""Suffixes of meshes."""


class Kind(NamedTuple):
    """A kind of export."""

    settings: type[Any]
    """Class of its settings."""
    suffixes: tuple[str, ...]
    """Suffixes that its file may have."""
    writer: str
    """Module in this room and function of the scene to export, the file and settings, which writes the file. They are
    imported on use, so that the help of the command is fast."""
    is_cropped: bool = True
    """Whether that function takes regions, too."""


def export(loaded: Loaded, name: str, path: Path, settings: Any, regions: Sequence[Region] = ()) -> None:
    """Write an export of a run or a file, and report it.

    Args:
        loaded: the run or file to export.
        name: kind of export, a key of `KINDS`.
        path: file to write.
        settings: settings of that kind.
        regions: the export keeps their intersection, in the frame and unit of exports; none for everything.

    Raises:
        ConfigError: if the kind, the file's suffix or a setting does not fit, or there is nothing to write.
        DataError: if data that the export needs cannot be read.
        OSError: if the file cannot be written.
    """
    kind = kind_named(name)
    if path.suffix.lower() not in kind.suffixes:
        raise ConfigError(f"{path}: {name} is written to {' or '.join(kind.suffixes)} files")
    if regions and not kind.is_cropped:
        croppable = ", ".join(other for other, one in KINDS.items() if one.is_cropped)
        raise ConfigError(f"{name} takes no region; {croppable} do")
    check_scale(loaded)
    path.parent.mkdir(parents=True, exist_ok=True)
    if loaded.scale.is_known:
        say(loaded.scale.words())
    write = resolve_name(f"nerfloom.export.{kind.writer}")
    write(loaded, path, settings, *([regions] if kind.is_cropped else []))


def check_scale(loaded: Loaded) -> None:
    """Refuse a run `loaded` with a scene that has no scale.

    Raises:
        ConfigError: if it is in normalised device coordinates.
    """
    if loaded.model.scene.warped:
        raise ConfigError("this run is in normalised device coordinates (--ndc), which have no scale to export")


def kind_named(name: str) -> Kind:
    """Return the kind of export of a `name`.

    Raises:
        ConfigError: if there is none.
    """
    if name not in KINDS:
        raise ConfigError(f"nothing is exported as '{name}'. {nearest(name, list(KINDS))}")
    return KINDS[name]


KINDS: dict[str, Kind] = {
    "pointcloud": Kind(PointSettings, (".ply",), "point_cloud:export_points"),
    "marching-cubes": Kind(MarchingCubesSettings, MESHES, "run_mesh:export_level_set"),
    "tsdf": Kind(TsdfSettings, MESHES, "run_mesh:export_fused"),
    "gaussian-splat": Kind(SplatSettings, (".ply", ".spz", ".sog", ".glb"), "run_gaussians:export_gaussians"),
    "levels": Kind(LevelsSettings, (".levels",), "run_levels:export_levels"),
    "cameras": Kind(CameraSettings, (".json",), "run_cameras:export_cameras", is_cropped=False),
    "occupancy": Kind(OccupancySettings, (".npz",), "occupancy:export_occupancy", is_cropped=False),
    "web": Kind(WebSettings, (".html",), "run_page:export_page"),
}
"""Kinds of export by name."""
