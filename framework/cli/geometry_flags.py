"""Flags that compare a run's surface with a reference, for `ns-eval` and `ns-compare`."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal

from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.base.extras import require

FILES = ("reference_mesh", "reference_points")
"""Settings that are files."""
SEVERAL = ("f_score_at",)
"""Settings of several values."""


@dataclass(frozen=True, kw_only=True)
class GeometryFlags:
    """The reference, and how the surface is compared with it."""

    reference_mesh: Path | None = None
    """Mesh of the true surface (.ply, .obj, .glb), in the input's frame and unit. The run's surface is compared with
    it."""
    reference_points: Path | None = None
    """Points on the true surface instead (.ply, normals optional)."""
    surface: Literal["auto", "marching-cubes", "tsdf"] = "auto"
    """Export that makes the mesh to judge. auto: marching-cubes of a signed distance, or of a density in a bounded
    scene, otherwise tsdf."""
    surface_resolution: int = 256
    """Number of cells along the longest edge of that export's box."""
    f_score_at: tuple[float, ...] = ()
    """Distances of F-scores, in the input's unit. Default: 0.25 % and 1 % of the reference's longest side."""
    min_views: int = 1
    """Number of training cameras that have to see a point of a surface; 0: all points count."""
    crop: float | None = None
    """Judge only surfaces in the reference's bounding box, enlarged by this fraction of its longest side."""

    @property
    def reference(self) -> Path | None:
        """The reference's file; None if there is none."""
        return self.reference_mesh or self.reference_points

    def check_geometry(self) -> None:
        """Check the flags, the reference's file and the installed packages, before any work.

        Raises:
            ConfigError: if something is wrong or missing.
        """
        if self.reference_mesh is not None and self.reference_points is not None:
            raise FlagError("--reference-mesh and --reference-points exclude each other: give one of them")
        if self.min_views < 0:
            raise FlagError(f"--min-views is {self.min_views}; it must be at least 0")
        if self.crop is not None and not 0 <= self.crop < math.inf:
            raise FlagError(f"--crop is {self.crop:g}; it must be at least 0")
        for distance in self.f_score_at:
            if not 0 < distance < math.inf:
                raise FlagError(f"--f-score-at is {distance:g}; it must be above zero")
        if self.reference is None:
            return
        if not self.reference.is_file():
            raise ConfigError(f"{self.reference} is not a file; give the mesh or the points of the true surface")
        require("export", "judging a surface needs")

    def words(self) -> tuple[str, ...]:
        """Return the flags that differ from their defaults, with absolute paths, for another command."""
        words: list[str] = []
        for field in fields(GeometryFlags):
            value = getattr(self, field.name)
            if value == field.default:
                continue
            value = value.resolve() if field.name in FILES else value
            words += ["--" + field.name.replace("_", "-"), *map(str, value if field.name in SEVERAL else (value,))]
        return tuple(words)
