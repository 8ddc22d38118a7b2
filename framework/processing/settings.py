"""Flags of the estimation of poses with COLMAP; without heavy imports, so that the command line starts quickly."""

from __future__ import annotations

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
    """Which images share a camera. auto: those in a folder with equal size, device and focal length."""
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
    """Train on the images for a short time with --robust, and write masks that leave out moving things."""
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
