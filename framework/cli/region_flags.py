"""Flags of the part of space that edits and exports keep."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.cli.flags import numbers_in

if TYPE_CHECKING:
    from nerfloom.geometry.regions import Box, Region, Sphere


@dataclass(frozen=True, kw_only=True)
class RegionFlags:
    """The part of space that is kept, in the frame and unit of exports. The intersection of several is kept."""

    crop_box: str | None = None
    """Keep the inside of a box: X,Y,Z,X,Y,Z, its minimum and its maximum corner. Default: everything."""
    crop_sphere: str | None = None
    """Keep the inside of a sphere: X,Y,Z,RADIUS."""
    region: Path | None = None
    """Keep the regions of a file: boxes, spheres and polygons on views, as the viewer saves them."""

    def box(self) -> Box | None:
        """Return the box of --crop-box; None if it is not given.

        Raises:
            FlagError: if it is no box.
        """
        from nerfloom.geometry.regions import Box

        if self.crop_box is None:
            return None
        x0, y0, z0, x1, y1, z1 = numbers_in(self.crop_box, 6, "--crop-box", "6 numbers X,Y,Z,X,Y,Z")
        try:
            return Box((x0, y0, z0), (x1, y1, z1))
        except ConfigError as error:
            raise FlagError(f"--crop-box: {error}") from error

    def sphere(self) -> Sphere | None:
        """Return the sphere of --crop-sphere; None if it is not given.

        Raises:
            FlagError: if it is no sphere.
        """
        from nerfloom.geometry.regions import Sphere

        if self.crop_sphere is None:
            return None
        x, y, z, radius = numbers_in(self.crop_sphere, 4, "--crop-sphere", "4 numbers X,Y,Z,RADIUS")
        try:
            return Sphere((x, y, z), radius)
        except ConfigError as error:
            raise FlagError(f"--crop-sphere: {error}") from error

    def regions(self) -> list[Region]:
        """Return all regions that are given.

        Raises:
            FlagError: if one of them is none.
            ConfigError: if the file of one cannot be read.
        """
        from nerfloom.geometry.regions import read_regions

        of_file = [] if self.region is None else read_regions(self.region)
        return [region for region in (self.box(), self.sphere(), *of_file) if region is not None]
