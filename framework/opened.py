"""A run or a file that is opened in Python: renders, evaluates and measures, and writes videos and exports."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerfloom.base.arguments import arguments_of
from nerfloom.base.errors import ConfigError, nearest
from nerfloom.training.loaded import Loaded

if TYPE_CHECKING:
    from nerfloom.export.point_cloud import PointCloud
    from nerfloom.geometry.regions import Region


class Opened(Loaded):
    """A loaded run, file of Gaussians or of levels, or octree, with renders and exports as of the commands."""

    @classmethod
    def of(cls, loaded: Loaded) -> Opened:
        """Return `loaded` with these methods; both share the images that have been read."""
        return cls(**vars(loaded))

    def render_path(self, name: str, file: str | Path, **settings: Any) -> None:
        """Render a video, an animation or images along a path, as `ns-render` does.

        Args:
            name: orbit, interpolate, spiral, camera-path, time or dataset.
            file: file to write, .mp4, .gif, .webp or .png, or a folder for images.
            settings: flags of `ns-render` by name, with underscores, as in `seconds=8, width=1920, height=1080`.

        Raises:
            ConfigError: if the path or a setting is unknown or out of range, or the path does not suit the run.
            DataError: if data that the path needs cannot be read.
        """
        from nerfloom.video.render import render_path
        from nerfloom.video.settings import PATHS

        if name not in PATHS:
            raise ConfigError(f"unknown path '{name}'. {nearest(name, list(PATHS))}")
        kind = PATHS[name]
        render_path(self, name, Path(file), kind(**arguments_of(kind, settings, "render_path()")))

    def export(self, kind: str, file: str | Path, *, regions: Sequence[Region] = (), **settings: Any) -> None:
        """Write points, a mesh, Gaussians, cameras, cells or a page to a file, as `ns-export` does.

        Args:
            kind: pointcloud, marching-cubes, tsdf, gaussian-splat, levels, cameras, occupancy or web.
            file: file to write; its suffix is the format, such as .ply, .glb, .spz or .html.
            regions: the export keeps their intersection, in the frame and unit of exports; none for everything.
            settings: flags of `ns-export` by name, with underscores, as in `max_megabytes=5`.

        Raises:
            ConfigError: if the kind, the file's suffix or a setting does not fit, or there is nothing to write.
            DataError: if data that the export needs cannot be read.
        """
        from nerfloom.export.kinds import export, kind_named

        chosen = kind_named(kind).settings
        export(self, kind, Path(file), chosen(**arguments_of(chosen, settings, "export()")), regions)

    def point_cloud(self, *, regions: Sequence[Region] = (), **settings: Any) -> PointCloud:
        """Return points on surfaces, with colours and normals, in the frame and unit of exports.

        Args:
            regions: points in all of these are kept, in the frame of exports; none for all points.
            settings: flags of `ns-export pointcloud` by name, with underscores, as in `num_points=100_000`.

        Raises:
            ConfigError: if a setting is unknown or out of range, there is no point, or the run has no scale
                (normalised device coordinates).
            DataError: if the photographs cannot be read.
        """
        from nerfloom.export.kinds import check_scale
        from nerfloom.export.point_cloud import point_cloud
        from nerfloom.export.settings import PointSettings

        check_scale(self)
        return point_cloud(self, PointSettings(**arguments_of(PointSettings, settings, "point_cloud()")), regions)
