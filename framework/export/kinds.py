"""Exports by name, in the frame and units of the input, for `ns-export` and `run.export`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, nearest
from nerfloom.export.occupancy import export_occupancy
from nerfloom.export.point_cloud import export_points
from nerfloom.export.run_cameras import export_cameras
from nerfloom.export.run_gaussians import export_gaussians
from nerfloom.export.run_levels import export_levels
from nerfloom.export.run_mesh import export_fused, export_level_set
from nerfloom.export.run_page import export_page, kind_of
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
from nerfloom.geometry.regions import Region
from nerfloom.renderable import HasDensity, HasSignedDistance, parts
from nerfloom.samplers.base import SkipsCells
from nerfloom.splats.gaussians import HasGaussians
from nerfloom.training.loaded import Loaded

MESHES = (".ply", ".obj", ".glb")
"""Suffixes of meshes."""


class Kind(NamedTuple):
    """A kind of export."""

    settings: type[Any]
    """Class of its settings."""
    suffixes: tuple[str, ...]
    """Suffixes that its file may have."""
    write: Callable[..., None]
    """Writes the file, given the run or file to export, the path, the settings and, if `is_cropped`, the regions."""
    suits: Callable[[Loaded], bool]
    """Returns whether a run or a file has what the export needs."""
    is_cropped: bool = False
    """Whether it takes regions."""


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
    if kind.is_cropped:
        kind.write(loaded, path, settings, regions)
    else:
        kind.write(loaded, path, settings)


def check_scale(loaded: Loaded) -> None:
    """Refuse a run `loaded` with a scene that has no scale.

    Raises:
        ConfigError: if it is in normalised device coordinates.
    """
    if loaded.model.scene.warped:
        raise ConfigError("this run is in normalised device coordinates (--ndc), which have no scale to export")


def kinds_of(loaded: Loaded) -> dict[str, Kind]:
    """Return the kinds of export that suit a run or a file, by name."""
    return {name: kind for name, kind in KINDS.items() if kind.suits(loaded)}


def kind_named(name: str) -> Kind:
    """Return the kind of export of a `name`.

    Raises:
        ConfigError: if there is none.
    """
    if name not in KINDS:
        raise ConfigError(f"nothing is exported as '{name}'. {nearest(name, list(KINDS))}")
    return KINDS[name]


# What they need; the writers say it in their errors.


def _has_photographs(loaded: Loaded) -> bool:
    return loaded.source is not None


def _has_surface(loaded: Loaded) -> bool:
    return isinstance(loaded.model, (HasDensity, HasSignedDistance)) and _has_photographs(loaded)


def _has_gaussians(loaded: Loaded) -> bool:
    return isinstance(loaded.model, HasGaussians)


def _has_cells(loaded: Loaded) -> bool:
    return bool(parts(loaded.model, SkipsCells))


def _has_page(loaded: Loaded) -> bool:
    return kind_of(loaded.model) != "gaussians" or _has_gaussians(loaded) or _has_photographs(loaded)


KINDS: dict[str, Kind] = {
    "pointcloud": Kind(PointSettings, (".ply",), export_points, _has_photographs, is_cropped=True),
    "marching-cubes": Kind(MarchingCubesSettings, MESHES, export_level_set, _has_surface, is_cropped=True),
    "tsdf": Kind(TsdfSettings, MESHES, export_fused, _has_photographs, is_cropped=True),
    "gaussian-splat": Kind(
        SplatSettings, (".ply", ".spz", ".sog", ".glb"), export_gaussians, _has_gaussians, is_cropped=True
    ),
    "levels": Kind(LevelsSettings, (".levels",), export_levels, _has_gaussians, is_cropped=True),
    "cameras": Kind(CameraSettings, (".json",), export_cameras, _has_photographs),
    "occupancy": Kind(OccupancySettings, (".npz",), export_occupancy, _has_cells),
    "web": Kind(WebSettings, (".html",), export_page, _has_page, is_cropped=True),
}
"""Kinds of export by name."""
