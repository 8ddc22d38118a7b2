"""Flags of each kind of input; without heavy imports, so that the command line starts quickly."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from nerfloom.base.errors import ConfigError, FlagError

CameraModel = Literal["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV_FISHEYE"]
"""COLMAP's lens models that transforms.json can express."""
Matching = Literal["auto", "exhaustive", "sequential", "retrieval"]
"""Rule for selecting image pairs to match."""


@dataclass(frozen=True, kw_only=True)
class OutputFlags:
    """Flags for every kind of input."""

    data: Path
    """Folder or file to read."""
    output_dir: Path
    """Folder to write; new or empty."""
    overwrite: bool = False
    """Replace the output of an earlier run in --output-dir; other files there are kept."""
    num_downscales: int = 3
    """Number of folders of reduced images: 3 writes images_2, images_4 and images_8."""
    can_resume: ClassVar[bool] = False
    """Whether a stopped run can continue where it stopped."""

    def check(self) -> None:
        """Check the values.

        Raises:
            ConfigError: if a number is out of range.
        """
        if not 0 <= self.num_downscales <= 8:
            raise FlagError(f"--num-downscales is {self.num_downscales}; it must be from 0 to 8")


@dataclass(frozen=True, kw_only=True)
class ViewFlags(OutputFlags):
    """Flags of the perspective views that panoramas are cut into."""

    num_views: int = 8
    """Number of views cut out of a panorama around the horizon, at equal angles; the first looks at its centre."""
    view_angle: float = 90.0
    """Angle of view of each, horizontal and vertical, degrees."""
    views_up_and_down: bool = False
    """Cut two further views that look straight up and straight down."""

    def check(self) -> None:
        super().check()
        if not 1 <= self.num_views <= 64:
            raise FlagError(f"--num-views is {self.num_views}; it must be from 1 to 64")
        if not 10 <= self.view_angle <= 150:
            raise FlagError(f"--view-angle is {self.view_angle}; it must be from 10 to 150 degrees")


@dataclass(frozen=True, kw_only=True)
class ColmapFlags(ViewFlags):
    """Flags of the estimation of poses."""

    camera_type: Literal["perspective", "equirectangular"] = "perspective"
    """Kind of the images: equirectangular ones are 360-degree panoramas, which are cut into perspective views."""
    camera_model: CameraModel = "OPENCV"
    """Lens model: OPENCV has distortion k1, k2, p1, p2; OPENCV_FISHEYE is for angles of view over about 120 degrees."""
    camera_sharing: Literal["auto", "single", "per-image"] = "auto"
    """Which images share a camera. auto: images in a folder with equal size, device and focal length."""
    matching_method: Matching = "auto"
    """Which images are matched. auto: for videos and numbered photographs, neighbours and loops, and more if some
    images remain; for others, all pairs up to --exhaustive-limit images, then retrieval."""
    exhaustive_limit: int = 150
    """Maximum number of images for auto to match all pairs, or all pairs with unregistered images."""
    num_neighbors: int = 30
    """Number of similar images that retrieval matches with each image."""
    sequential_overlap: int = 10
    """Number of following images that sequential matching matches with each, besides those 16, 32, ... further on."""
    max_image_size: int = 1600
    """Longer side of images for extracting features, pixels."""
    max_num_features: int = 8192
    """Maximum number of features of an image."""
    refine_intrinsics: bool = False
    """Refine everything once more at the end with a free principal point, for cameras with 10 images or more. Use it
    only for captures that determine that point well: its shift is hard to distinguish from a camera rotation."""
    undistort: bool = False
    """Write images without lens distortion (camera model PINHOLE), for registered images only."""
    mask_moving: bool = False
    """Train a field on the images for a short time, as a scout, and write masks that leave out moving things."""
    mask_seconds: float = 120.0
    """Seconds of this training."""
    device_type: Literal["cpu", "cuda"] = "cpu"
    """Device for feature extraction and matching; cuda needs a pycolmap built with CUDA."""
    num_threads: int = -1
    """CPU threads; -1 for all."""
    resume: bool = False
    """Continue a stopped run: features and matches in --output-dir are kept."""
    verbose: bool = False
    """Show COLMAP's output instead of writing it to OUTPUT_DIR/colmap/log.txt."""
    can_resume = True

    def check(self) -> None:
        super().check()
        if self.resume and self.overwrite:
            raise FlagError("--overwrite removes what --resume continues; leave out one of them")
        if self.camera_type == "equirectangular" and self.camera_model == "OPENCV_FISHEYE":
            raise FlagError("--camera-type equirectangular cuts perspective views; leave out --camera-model")
        if self.camera_type == "equirectangular" and self.refine_intrinsics:
            raise FlagError("--camera-type equirectangular: the lens of views is exact; leave out --refine-intrinsics")
        minimums = {
            "exhaustive_limit": 0, "num_neighbors": 1, "sequential_overlap": 1,
            "max_image_size": 64, "max_num_features": 64,
        }  # fmt: skip
        for name, minimum in minimums.items():
            if getattr(self, name) < minimum:
                flag = "--" + name.replace("_", "-")
                raise ConfigError(f"{flag} is {getattr(self, name)}; it must be at least {minimum}")
        if not self.mask_seconds > 0:
            raise FlagError(f"--mask-seconds is {self.mask_seconds}; it must be more than 0")
        if self.num_threads < 1 and self.num_threads != -1:
            raise FlagError(f"--num-threads is {self.num_threads}; it must be at least 1, or -1 for all")


@dataclass(frozen=True, kw_only=True)
class ImagesFlags(ColmapFlags):
    """Estimate the poses of the images in a folder and its subfolders."""

    masks_dir: Path | None = None
    """Folder of masks with the images' names; black pixels are ignored for poses and training."""

    def check(self) -> None:
        super().check()
        if self.masks_dir is not None and self.undistort:
            raise ConfigError("--masks-dir with --undistort: masks are not undistorted; leave one of them out")
        if self.masks_dir is not None and self.mask_moving:
            raise ConfigError("--masks-dir with --mask-moving: an image has one mask; leave one of them out")
        if self.masks_dir is not None and self.camera_type == "equirectangular":
            raise ConfigError("--masks-dir with --camera-type equirectangular: masks are not cut; leave out one")
        if self.masks_dir is not None and not self.masks_dir.is_dir():
            raise ConfigError(f"--masks-dir {self.masks_dir}: there is no such folder")


@dataclass(frozen=True, kw_only=True)
class VideoFlags(ColmapFlags):
    """Estimate the poses of the sharpest frames of a video."""

    num_frames_target: int = 300
    """Number of frames to take. The video is split into this many equal intervals; each gives its sharpest frame."""

    def check(self) -> None:
        super().check()
        if self.num_frames_target < 3:
            raise FlagError(f"--num-frames-target is {self.num_frames_target}; it must be at least 3")


@dataclass(frozen=True, kw_only=True)
class RecordingFlags(OutputFlags):
    """Flags of recordings of a device, which has measured the poses."""

    max_dataset_size: int = 300
    """Maximum number of images to take, evenly spaced; -1 for all."""

    def check(self) -> None:
        super().check()
        if self.max_dataset_size < 2 and self.max_dataset_size != -1:
            raise FlagError(f"--max-dataset-size is {self.max_dataset_size}; it must be at least 2, or -1 for all")

    @property
    def most(self) -> int:
        """Maximum number of images to take."""
        return sys.maxsize if self.max_dataset_size == -1 else self.max_dataset_size


@dataclass(frozen=True, kw_only=True)
class PolycamFlags(RecordingFlags):
    """Convert Polycam's raw export."""

    min_blur_score: float = 25.0
    """Minimum score of sharpness, from Polycam; images with a lower score are omitted."""
    crop_border_pixels: int = 15
    """Pixels to crop at each side, since Polycam's images may have a black border."""

    def check(self) -> None:
        super().check()
        if self.crop_border_pixels < 0:
            raise FlagError(f"--crop-border-pixels is {self.crop_border_pixels}; it must be at least 0")


@dataclass(frozen=True, kw_only=True)
class Record3DFlags(RecordingFlags):
    """Convert Record3D's export with EXR and RGBD."""

    ply: Path | None = None
    """Points that Record3D has exported of the same recording: a PLY file, or a folder or a zip file of several."""


@dataclass(frozen=True, kw_only=True)
class ProgramFlags(ViewFlags):
    """Flags of captures that another program placed."""

    panoramas: Literal["views", "whole"] = "views"
    """Treatment of panoramas. views: cut into perspective views. whole: kept, if a capture has no other images."""


@dataclass(frozen=True, kw_only=True)
class MetashapeFlags(ProgramFlags):
    """Convert photographs (--data, a folder) with the cameras of Agisoft Metashape."""

    xml: Path
    """File of the cameras: File > Export > Export Cameras, as Agisoft XML."""
    ply: Path | None = None
    """Points (PLY), in local coordinates; of a georeferenced chunk, in WGS 84 geocentric coordinates (EPSG:4978)."""


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
    """List of the images, in the order of the cameras. Default: list.txt beside the bundle or one folder up."""


@dataclass(frozen=True, kw_only=True)
class AriaFlags(ProgramFlags, RecordingFlags):
    """Convert images of Project Aria glasses (--data, a folder that vrs extract-all has written) with MPS's results."""

    mps_data_dir: Path
    """Folder of MPS's results: closed_loop_trajectory.csv, online_calibration.jsonl and, if there, semidense points,
    also in its folder slam."""
    num_views: int = 1
    """Number of views cut out of an image; the first looks ahead."""
