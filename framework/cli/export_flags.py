"""Flags of `ns-export`: a run, where to write, and the settings of an export."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from nerfloom.base.changed import refuse
from nerfloom.base.errors import ConfigError
from nerfloom.cli.region_flags import RegionFlags
from nerfloom.cli.run_flags import RunFlags
from nerfloom.export.settings import (
    CameraSettings,
    LevelsSettings,
    MarchingCubesSettings,
    MeshSettings,
    OccupancySettings,
    PointSettings,
    SplatSettings,
    TsdfSettings,
    WebSettings,
)

if TYPE_CHECKING:
    from nerfloom.geometry.regions import Region
    from nerfloom.training.file_data import DataFormat


@dataclass(frozen=True, kw_only=True)
class ExportFlags(RunFlags):
    """Flags of every export."""

    output_dir: Path
    """Folder to write to."""

    def regions(self) -> list[Region]:
        """Return the regions that are kept; none for everything."""
        return []

    def write(self, name: str, found: Path, data_format: DataFormat | None, path: Path) -> None:
        """Load the run or the file that `check` has found, and write an export of it.

        Args:
            name: kind of export.
            found: the result of `check`.
            data_format: data format for a file, with its flags; None to detect it.
            path: file to write.

        Raises:
            ConfigError, CheckpointError, DataError: if the run or the file cannot be used or exported.
            OSError: if the file cannot be written.
        """
        from nerfloom.export.kinds import export

        regions = self.regions()  # before anything is loaded
        export(self.load(found, data_format), name, path, self, regions)


@dataclass(frozen=True, kw_only=True)
class PointFlags(PointSettings, RegionFlags, ExportFlags):
    """Write point_cloud.ply: points at the median depth of random training rays."""


@dataclass(frozen=True, kw_only=True)
class CameraFlags(CameraSettings, ExportFlags):
    """Write cameras as nerfstudio/transforms.json, colmap/sparse/0/*.txt, and transforms_train.json."""


@dataclass(frozen=True, kw_only=True)
class OccupancyFlags(OccupancySettings, ExportFlags):
    """Write occupancy.npz, the occupancy grid, and occupancy.ply, its occupied cells."""


@dataclass(frozen=True, kw_only=True)
class SplatFlags(SplatSettings, RegionFlags, ExportFlags):
    """Write splat.ply, .spz, .sog or .glb: Gaussians for viewers and the code of 3D Gaussian Splatting."""

    format: Literal["ply", "spz", "sog", "glb"] = "ply"
    """ply: 32 bits per number, supported by every program; spz: 8 to 24 bits, compressed to about a tenth; sog: images
    in a zip file, for PlayCanvas; glb: glTF with KHR_gaussian_splatting, y up."""


@dataclass(frozen=True, kw_only=True)
class LevelsFlags(LevelsSettings, RegionFlags, ExportFlags):
    """Write scene.levels: Gaussians in chunks, with fewer and larger ones for distant parts.

    Commands open it like a file of Gaussians, and load the chunks that a view needs. A binary PLY file may be larger
    than memory.
    """

    def write(self, name: str, found: Path, data_format: DataFormat | None, path: Path) -> None:
        from nerfloom.export.run_levels import export_file_levels
        from nerfloom.splats.files import is_splat_file

        if not is_splat_file(found):
            super().write(name, found, data_format, path)
            return
        if self.data is not None or data_format is not None or self.up is not None:
            raise ConfigError("a file of Gaussians keeps its frame as levels: leave out --data, --up and the format")
        refuse({"load_checkpoint": self.load_checkpoint, **self.changes()}, "a file of Gaussians")
        export_file_levels(found, path, self, self.regions())


@dataclass(frozen=True, kw_only=True)
class WebFlags(WebSettings, RegionFlags, ExportFlags):
    """Write scene.html: a page that shows the scene's Gaussians or octree, or ones that are made from a field.

    Beside it, scene.jpg is the start view, for link previews. For a file of levels, the folder scene has chunks that
    the page loads from a web server.
    """


@dataclass(frozen=True, kw_only=True)
class MeshFlags(MeshSettings, RegionFlags, ExportFlags):
    """Flags of every mesh."""

    format: Literal["ply", "obj", "glb"] = "ply"
    """File format; ply is the smallest and fastest. In glb, y is up."""


@dataclass(frozen=True, kw_only=True)
class MarchingCubesFlags(MarchingCubesSettings, MeshFlags):
    """Write a mesh of the surface of a field, with colours and normals.

    The surface is where the density passes a level, or where a signed distance is zero.
    """


@dataclass(frozen=True, kw_only=True)
class TsdfFlags(TsdfSettings, MeshFlags):
    """Write a mesh of the surfaces that training cameras see, from fused depth images; works with every method."""
