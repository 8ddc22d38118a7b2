"""The point cloud of a run: on its surfaces, in the frame and units of the input."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from nerfloom.base.console import say, track
from nerfloom.base.counts import counted
from nerfloom.base.device import seed_step
from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.base.extras import require
from nerfloom.data.ply import write_points
from nerfloom.export.neighbors import inliers, plane_normals
from nerfloom.export.points import joined, num_views, picture_points, surface_points
from nerfloom.export.settings import PointSettings
from nerfloom.geometry.regions import Region, inside_all
from nerfloom.renderable import RendersRays
from nerfloom.training.loaded import Loaded


@dataclass(frozen=True)
class PointCloud:
    """K points on surfaces, in the frame and unit of exports."""

    positions: Tensor
    """(K, 3) positions, float64."""
    colors: Tensor
    """(K, 3) colours in [0, 1]."""
    normals: Tensor | None = None
    """(K, 3) unit normals, float32; None without."""

    def __len__(self) -> int:
        return len(self.positions)

    def write(self, file: str | Path) -> None:
        """Write the points to a PLY file.

        Args:
            file: path of the file.

        Raises:
            OSError: if it cannot be written.
        """
        write_points(Path(file), self.positions, self.colors, self.normals)


def point_cloud(loaded: Loaded, settings: PointSettings, regions: Sequence[Region] = ()) -> PointCloud:
    """Return points at the median depth of random training rays.

    Args:
        loaded: the run, or a file with photographs.
        settings: settings of the points.
        regions: points in all of these are kept, in the frame of exports.

    Raises:
        ConfigError: if a setting is out of range, packages are missing, or there is no point.
        DataError: if the photographs cannot be read.
    """
    if settings.num_points < 1 or not settings.reach >= 0 or not settings.std_ratio >= 0:
        raise FlagError("--num-points must be at least 1, --reach and --std-ratio at least 0")
    if settings.remove_outliers or settings.estimate_normals:
        require("export", "--remove-outliers and --estimate-normals need", "; or set both to False")
    model, dataset = loaded.model, loaded.dataset("train")
    seed_step(loaded.run.config.machine.seed, 0)
    if isinstance(model, RendersRays):
        chunks = -(-settings.num_points // model.rays_at_once)
        parts = surface_points(model, dataset, settings.num_points, settings.reach or None)
    else:
        chunks = num_views(dataset)
        parts = picture_points(model, dataset, settings.num_points, settings.reach or None)
    found = joined(track(parts, "Looking for surfaces", total=chunks))
    if not len(found.positions):
        raise ConfigError("no training ray ends in a surface inside --reach; is the run trained? --reach 0 keeps all")
    if regions:
        found = found[inside_all(loaded.placement.original_points(found.positions), regions)]
    if settings.remove_outliers:
        kept = inliers(found.positions, settings.std_ratio)
        say(f"{len(kept) - int(kept.sum()):,} of {len(kept):,} points are outliers and left out (--remove-outliers)")
        found = found[kept]
    normals = found.normals
    if normals is None and settings.estimate_normals:
        normals = plane_normals(found.positions, -found.directions)
    positions = loaded.placement.original_points(found.positions)
    normals = None if normals is None else loaded.placement.original_directions(normals).float()
    return PointCloud(positions, found.colors, normals)


def export_points(loaded: Loaded, path: Path, settings: PointSettings, regions: Sequence[Region] = ()) -> None:
    """Write the point cloud of a run, and say how many points it has.

    Args:
        loaded: the run, or a file with photographs.
        path: PLY file to write.
        settings: settings of the points.
        regions: points in all of these are kept, in the frame of exports.

    Raises:
        ConfigError: as `point_cloud`.
    """
    found = point_cloud(loaded, settings, regions)
    found.write(path)
    say(f"{counted(len(found), 'points')}: {path}")
