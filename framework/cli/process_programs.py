"""The kinds of `ns-process-data` for photographs whose cameras another program has placed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from nerfloom.base.errors import DataError
from nerfloom.processing.settings import OutputFlags, ViewFlags

if TYPE_CHECKING:
    from nerfloom.processing.capture import Capture


@dataclass(frozen=True, kw_only=True)
class ProgramFlags(ViewFlags):
    """Flags of captures that another program placed."""

    panoramas: Literal["views", "whole"] = "views"
    """What becomes of panoramas: perspective views for any method, or whole, for methods that cast rays."""


@dataclass(frozen=True, kw_only=True)
class MetashapeFlags(ProgramFlags):
    """Convert photographs (--data, a folder) with the cameras of Agisoft Metashape."""

    xml: Path
    """File of the cameras: File > Export > Export Cameras, as Agisoft XML."""
    ply: Path | None = None
    """Points (PLY), exported in the coordinate system of the chunk."""


@dataclass(frozen=True, kw_only=True)
class RealityCaptureFlags(ProgramFlags):
    """Convert photographs (--data, a folder) with the cameras of RealityCapture or RealityScan."""

    csv: Path
    """File of the cameras: Registration, Internal/External camera parameters."""
    ply: Path | None = None
    """Points (PLY), exported in the same coordinate system."""


@dataclass(frozen=True, kw_only=True)
class OdmFlags(ProgramFlags):
    """Convert a project's folder (--data) of OpenDroneMap or OpenSfM."""

    images_dir: Path | None = None
    """Folder of the photographs. Default: the folder images of the project."""


@dataclass(frozen=True, kw_only=True)
class BundlerFlags(ProgramFlags):
    """Convert photographs (--data, a folder) with a reconstruction of Bundler, which many programs write."""

    bundle: Path
    """File of cameras and points, such as bundle.out."""
    image_list: Path | None = None
    """List of the images, in the order of the cameras. Default: list.txt beside the bundle."""


def _convert_metashape(flags: MetashapeFlags) -> None:
    from nerfloom.processing.metashape import read_capture
    from nerfloom.processing.point_files import with_points

    _convert(flags, flags.data, with_points(read_capture(flags.xml), flags.ply))


def _convert_realitycapture(flags: RealityCaptureFlags) -> None:
    from nerfloom.processing.point_files import with_points
    from nerfloom.processing.realitycapture import read_capture

    _convert(flags, flags.data, with_points(read_capture(flags.csv), flags.ply))


def _convert_odm(flags: OdmFlags) -> None:
    from nerfloom.processing.opensfm import find_reconstruction, read_capture

    default = flags.data / "images" if (flags.data / "images").is_dir() else flags.data
    _convert(flags, flags.images_dir or default, read_capture(find_reconstruction(flags.data)))


def _convert_bundler(flags: BundlerFlags) -> None:
    from nerfloom.processing.bundler import read_capture

    listed = flags.bundle.with_name("list.txt") if flags.image_list is None else flags.image_list
    _convert(flags, flags.data, read_capture(flags.bundle, listed))


def _convert(flags: ProgramFlags, images: Path, capture: Capture) -> None:
    from nerfloom.processing.named_images import placed_images
    from nerfloom.processing.output import claim
    from nerfloom.processing.posed_folder import write_capture
    from nerfloom.processing.views import Views

    if not images.is_dir():
        raise DataError(f"{images} is not a folder; it must be that of the photographs")
    placed = placed_images(images, capture)
    claim(flags.output_dir, flags.data, flags.overwrite)
    views = Views(flags.num_views, flags.view_angle, flags.views_up_and_down)
    kept = None if flags.panoramas == "whole" else views
    write_capture(images, capture, placed, flags.output_dir, flags.num_downscales, kept)


PROGRAMS: dict[str, tuple[type[OutputFlags], Callable[[Any], None]]] = {
    "metashape": (MetashapeFlags, _convert_metashape),
    "realitycapture": (RealityCaptureFlags, _convert_realitycapture),
    "odm": (OdmFlags, _convert_odm),
    "bundler": (BundlerFlags, _convert_bundler),
}
"""Flags and function of each kind, by name."""
