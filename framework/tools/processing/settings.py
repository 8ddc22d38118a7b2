"""What finding camera poses with COLMAP can be told; light, so that the command line starts quickly."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from framework.base.errors import ConfigError

CameraModel = Literal["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV_FISHEYE"]
Matching = Literal["auto", "exhaustive", "sequential", "retrieval"]


@dataclass(frozen=True, kw_only=True)
class OutputFlags:
    """What every kind of input can be told."""

    data: Path
    """What to read."""
    output_dir: Path
    """The folder to write; new or empty."""
    overwrite: bool = False
    """Replace what an earlier run wrote into --output-dir; other files there are left alone."""
    num_downscales: int = 3
    """Halved copies of the images: 3 writes images_2, images_4 and images_8."""

    def check(self) -> None:
        """Raises: ConfigError for a number out of range."""
        if not 0 <= self.num_downscales <= 8:
            raise ConfigError(f"--num-downscales is {self.num_downscales}; it must be from 0 to 8")


@dataclass(frozen=True, kw_only=True)
class ColmapFlags(OutputFlags):
    """How poses are found."""

    camera_model: CameraModel = "OPENCV"
    """The lens: OPENCV bends by k1, k2, p1, p2; OPENCV_FISHEYE is for more than about 120 degrees."""
    camera_sharing: Literal["auto", "single", "per-image"] = "auto"
    """Which photographs share a camera. auto: those of a folder with equal size, device and focal length."""
    matching_method: Matching = "auto"
    """Which photographs are compared. auto: all pairs up to --exhaustive-limit, then retrieval; a video: neighbours."""
    exhaustive_limit: int = 150
    """The most photographs of which auto compares all pairs."""
    num_neighbors: int = 30
    """Similar photographs each one is compared with by retrieval."""
    sequential_overlap: int = 10
    """Following photographs each one is compared with by sequential matching; those 16, 32, ... further on, too."""
    max_image_size: int = 1600
    """Longest side, in pixels, at which features are looked for."""
    max_num_features: int = 8192
    """The most features of a photograph."""
    refine_intrinsics: bool = False
    """Adjust everything once more at the end with the principal point free, for cameras of 10 photographs or more. A
    turn of the camera looks much like a move of that point: only for captures that determine it well."""
    undistort: bool = False
    """Write images without lens distortion (camera model PINHOLE), of the registered photographs alone."""
    device_type: Literal["cpu", "cuda"] = "cpu"
    """Where features are found and matched; cuda needs a pycolmap built with it."""
    num_threads: int = -1
    """Threads to use; -1 for all."""
    verbose: bool = False
    """Show what COLMAP prints; it is kept in OUTPUT_DIR/colmap/log.txt otherwise."""

    def check(self) -> None:
        super().check()
        at_least = {
            "exhaustive_limit": 0, "num_neighbors": 1, "sequential_overlap": 1,
            "max_image_size": 64, "max_num_features": 64,
        }  # fmt: skip
        for name, least in at_least.items():
            if getattr(self, name) < least:
                flag = "--" + name.replace("_", "-")
                raise ConfigError(f"{flag} is {getattr(self, name)}; it must be at least {least}")
        if self.num_threads < 1 and self.num_threads != -1:
            raise ConfigError(f"--num-threads is {self.num_threads}; it must be at least 1, or -1 for all")
