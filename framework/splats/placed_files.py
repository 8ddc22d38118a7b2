"""Writing of Gaussians in the frame of the input, wherever in it they are."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from nerfloom.cameras.camera_path import CameraPath
from nerfloom.cameras.kept_cameras import kept_cameras, write_cameras
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.scale import Scale, write_scale
from nerfloom.data.offsets import write_offset
from nerfloom.geometry.local_origin import local_origin
from nerfloom.renderable import Renderable, training_poses
from nerfloom.splats.files import write_gaussians
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import Look
from nerfloom.splats.spz_container import SpzVersion
from nerfloom.splats.transform import transformed_in_float64


def in_input(gaussians: Gaussians, placement: Placement) -> Gaussians:
    """Return Gaussians of a scene in the frame of the input, with centres in float64.

    Args:
        gaussians: N Gaussians, scene coordinates.
        placement: placement of the input in the scene.
    """
    return transformed_in_float64(gaussians, *placement.original_similarity())


def capture_cameras(model: Renderable, placement: Placement) -> CameraPath | None:
    """Return the cameras to keep beside a file of the Gaussians of a capture; None for others.

    Around an object, a camera may be anywhere.

    Args:
        model: the model of the Gaussians.
        placement: placement of the file's input in its scene.
    """
    poses, scene = training_poses(model), model.scene
    if poses is None or not len(poses) or not scene.unbounded or scene.warped or scene.num_scenes > 1:
        return None
    return kept_cameras(poses, placement)


def write_placed(
    file: Path,
    gaussians: Gaussians,
    look: Look,
    scale: Scale,
    placement: Placement,
    max_megabytes: float | None = None,
    spz_version: SpzVersion = 2,
    cameras: CameraPath | None = None,
) -> list[str]:
    """Write Gaussians in the frame of the input, about a local origin where float32 is too coarse for it.

    The origin is written to an offset file beside, the unit to a file of the scale, and the cameras to a file of their
    own. In a .glb file everything is turned so that up is +y, the origin too; it has no cameras, since it is not read.

    Args:
        file: path of the file, with a suffix of `SUFFIXES`.
        gaussians: N Gaussians on the CPU, with centres in float64.
        scale: the unit of their coordinates.
        placement: placement of their frame in a scene with +z up.
        max_megabytes: maximum size of the file in millions of bytes; None for any.
        spz_version: version of SPZ files.
        cameras: cameras of the capture, placed for this input (`capture_cameras`); None for none.

    Returns:
        Sentences for the user about losses and the local origin.

    Raises:
        ConfigError: if the format cannot hold the Gaussians, or no file fits the size.
        OSError: if a file cannot be written.
    """
    if file.suffix.lower() == ".glb":
        cameras = None
        gaussians = transformed_in_float64(gaussians, placement.to_y_up(), 1.0, torch.zeros(3, dtype=torch.float64))
    origin = local_origin(gaussians.means, gaussians.typical_size)
    means = gaussians.means if origin is None else gaussians.means - origin
    said = write_gaussians(file, replace(gaussians, means=means.float()), max_megabytes, look, spz_version)
    if sentence := write_offset(file, origin):
        said.append(sentence)
    write_scale(file, scale)
    write_cameras(file, cameras)
    return said
