"""Settings of each export. This module does not import torch, so that help is fast."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from nerfloom.base.errors import FlagError

MIN_TEXTURE, MAX_TEXTURE = 64, 16_384
"""Bounds of a texture's edge, in texels."""
PageKind = Literal["gaussians", "octree"]
"""Content of a web page."""


@dataclass(frozen=True, kw_only=True)
class PointSettings:
    """Points at the median depth of random training rays."""

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
class CameraSettings:
    """Cameras of all photographs."""

    relative_paths: bool = False
    """Write image paths relative to transforms.json instead of absolute paths."""


@dataclass(frozen=True, kw_only=True)
class OccupancySettings:
    """The occupancy grid, and its occupied cells."""

    cells: Literal["centers", "boxes"] = "centers"
    """Content of occupancy.ply: the cells' centres, or the surface of their boxes."""


@dataclass(frozen=True, kw_only=True)
class SplatSettings:
    """Gaussians for viewers and the code of 3D Gaussian Splatting."""

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
class LevelsSettings:
    """Gaussians in a tree of levels of detail, for scenes that are larger than memory."""

    chunk_size: int = 50_000
    """Maximum number of Gaussians in a chunk, 16 to 1,048,576. A picture loads whole chunks."""
    bits: Literal[16, 32] = 32
    """Bits of each number but positions, which have 32. 16 halves the file and the time to read it."""
    build_memory: float = 2000.0
    """Maximum memory for building, MB (1e6 bytes), besides the memory of a loaded run."""
    time: float | None = None
    """Time of a moving scene, 0 to 1. Default: 0."""


@dataclass(frozen=True, kw_only=True)
class WebSettings:
    """A page that shows the scene's Gaussians or octree, or ones that are made from a field."""

    kind: PageKind | None = None
    """What the page shows. octree: a run is baked, as by ns-bake; gaussians: they are fitted to what has none. Default:
    the octree of an octree's file or of a run of voxels, else Gaussians."""
    max_megabytes: float = 30.0
    """Maximum size of the page, MB (1e6 bytes), up to 32. Harmonics are reduced first, Gaussians or leaves last."""
    fit_seconds: float = 60.0
    """Seconds for fitting Gaussians to pictures of a field, or for an octree to learn from the photographs."""
    time: float | None = None
    """Time of a moving scene, 0 to 1. Default: 0."""
    title: str | None = None
    """Heading of the page and of its link previews. Default: the run's names."""
    start_view: str | None = None
    """Training photograph, by its file name; the page starts at its camera. Default: the first one."""
    url: str | None = None
    """Address that the page will have, as in https://example.org/cup/scene.html; link previews need it to find their
    picture."""


@dataclass(frozen=True, kw_only=True)
class MeshSettings:
    """Settings of every mesh."""

    resolution: int = 256
    """Number of cells along the longest edge of the scene's box, or of the region, up to 1024."""
    num_components: int = 0
    """Maximum number of separate pieces to keep, largest first; 0: all."""
    min_component_share: float = 0.001
    """Remove pieces with fewer faces than this fraction of the largest piece's."""
    min_views: int | None = None
    """Remove faces that fewer training cameras see; 0: keep all. Default: 1 for a signed distance with a background,
    which has surfaces below a floor and at the back of walls, otherwise 0."""
    target_num_faces: int | None = None
    """Simplify the mesh to this number of faces. Default: no simplification."""
    texture_size: int | None = None
    """Edge length of a texture for obj and glb, texels, such as 4096. Default: no texture, colours at vertices."""
    texture_seconds: float = 300.0
    """Maximum seconds for the texture; the rest of it gets the vertices' colours."""

    def check_ranges(self) -> None:
        """Check all numbers.

        Raises:
            FlagError: if one is out of range.
        """
        if self.min_views is not None and self.min_views < 0:
            raise FlagError(f"--min-views is {self.min_views}; it must be at least 0")
        if self.num_components < 0 or not 0 <= self.min_component_share <= 1:
            raise FlagError("--num-components must be at least 0, and --min-component-share from 0 to 1")
        if self.target_num_faces is not None and self.target_num_faces < 4:
            raise FlagError(f"--target-num-faces is {self.target_num_faces}; it must be at least 4")
        if self.texture_size is not None and not MIN_TEXTURE <= self.texture_size <= MAX_TEXTURE:
            raise FlagError(f"--texture-size is {self.texture_size}; it must be from {MIN_TEXTURE} to {MAX_TEXTURE}")
        if not self.texture_seconds > 0:
            raise FlagError(f"--texture-seconds is {self.texture_seconds:g}; it must be above zero")


@dataclass(frozen=True, kw_only=True)
class MarchingCubesSettings(MeshSettings):
    """A mesh of the surface of a field, with colours and normals.

    The surface is where the density passes a level, or where a signed distance is zero.
    """

    isosurface_threshold: float | None = None
    """Density of the surface, per scene unit. Default: the density that makes 1/32 of the scene's box half opaque."""
    time: float = 0.0
    """Time of a moving scene, 0 to 1."""

    def check_ranges(self) -> None:
        super().check_ranges()
        if self.isosurface_threshold is not None and not 0 < self.isosurface_threshold < math.inf:
            raise FlagError(f"--isosurface-threshold is {self.isosurface_threshold:g}; it must be above zero")
        if not 0 <= self.time <= 1:
            raise FlagError(f"--time is {self.time:g}; it must be from 0 to 1")


@dataclass(frozen=True, kw_only=True)
class TsdfSettings(MeshSettings):
    """A mesh of the surfaces that the training cameras see, from their fused depth images; works with every method."""

    truncation: float = 4.0
    """Depth images count up to this distance from the surface, cells; larger is smoother, smaller keeps thin
    parts."""
    max_num_views: int = 200
    """Maximum number of rendered training views, evenly spaced."""

    def check_ranges(self) -> None:
        super().check_ranges()
        if self.max_num_views < 1:
            raise FlagError(f"--max-num-views is {self.max_num_views}; it must be at least 1")
