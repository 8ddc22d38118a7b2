"""The file transforms.json in nerfstudio's format: lenses, camera-to-world poses with OpenGL axes, and file names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerfloom.base.errors import DataError

POINTS = "sparse_pc.ply"
"""File of the points beside transforms.json."""
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
"""(3, 4) transform from COLMAP's frame, which tends to have y down, to one with z up."""

_PARAMETERS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fl_x", "fl_y", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4"),
}
"""Names of COLMAP's parameters in their order; f stands for both focal lengths."""


@dataclass(frozen=True)
class Lens:
    """Intrinsics shared by the images of a camera."""

    model: str
    """OPENCV, OPENCV_FISHEYE, PINHOLE or EQUIRECTANGULAR; FISHEYE624 for images that are cut (`aria_lens.py`)."""
    values: dict[str, float]
    """w, h, fl_x, fl_y, cx, cy in pixels (the first pixel's centre is at 0.5), and the model's k1, k2, ..."""


@dataclass(frozen=True)
class Frame:
    """An image with its pose."""

    name: str
    """Path in the images' folder, with '/'."""
    pose: np.ndarray
    """(3 or 4, 4) camera-to-world, OpenGL axes."""
    lens: Lens
    """Lens of the image."""
    mask: str | None = None
    """Path in the masks' folder."""
    image_id: int | None = None
    """COLMAP's number of the image."""
    source: str | None = None
    """Path of the original in the input folder."""


def lens_of(model: str, width: int, height: int, parameters: Sequence[float]) -> Lens:
    """Convert a COLMAP camera to a lens; models that are special cases of OPENCV become OPENCV.

    Args:
        model: COLMAP's name of the model.
        width, height: size of the images, pixels.
        parameters: parameters in COLMAP's order.

    Raises:
        DataError: for a model that transforms.json cannot express.
    """
    if model not in _PARAMETERS:
        raise DataError(f"transforms.json cannot express camera model {model}; it supports {', '.join(_PARAMETERS)}")
    by_name = dict(zip(_PARAMETERS[model], map(float, parameters), strict=True))
    focal = by_name.pop("f", None)
    if focal is not None:
        by_name = {"fl_x": focal, "fl_y": focal, **by_name}
    distortion: tuple[str, ...] = ()
    if model.endswith("PINHOLE"):
        kind = "PINHOLE"
    elif model == "OPENCV_FISHEYE":
        kind, distortion = model, ("k1", "k2", "k3", "k4")
    else:
        kind, distortion = "OPENCV", ("k1", "k2", "p1", "p2")
    ordered = {"w": width, "h": height, **{key: by_name[key] for key in ("fl_x", "fl_y", "cx", "cy")}}
    return Lens(kind, ordered | {key: by_name.get(key, 0.0) for key in distortion})


def rigid(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return the rigid transform (4, 4) with a `rotation` (3, 3) and a `position` (3,)."""
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation, position
    return transform


def camera_pose(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return camera-to-world (4, 4), OpenGL axes, from `rotation` (3, 3), y down, z ahead, and `position` (3,)."""
    return rigid(rotation * [1, -1, -1], position)


def opengl_pose(world_to_camera: np.ndarray) -> np.ndarray:
    """Return camera-to-world (4, 4), OpenGL axes (y up, looking along -z), of `world_to_camera` (3, 4) with y down."""
    rotation, translation = world_to_camera[:, :3], world_to_camera[:, 3]
    return camera_pose(rotation.T, -rotation.T @ translation)


def transformed(poses: np.ndarray, transform: np.ndarray) -> np.ndarray:
    """Return camera-to-world `poses` (..., 4, 4) after a change of the world's frame by `transform` (3, 4)."""
    return np.concatenate([transform, [[0.0, 0, 0, 1]]]) @ poses


def content(frames: list[Frame], applied: np.ndarray, points: str | None, more: dict[str, Any]) -> dict[str, Any]:
    """Return the content of a transforms.json.

    Args:
        frames: at least one; a lens that all share is written at the top, otherwise each frame has its own.
        applied: (3, 4) transform from the original frame (COLMAP's or the phone's) to the frame of `frames`.
        points: name of the point cloud in the same folder, or None.
        more: further entries at the top.

    Raises:
        DataError: if the frames have different camera models.
    """
    models = {frame.lens.model for frame in frames}
    if len(models) > 1:
        raise DataError(f"transforms.json can hold one camera model, not {' and '.join(sorted(models))}")
    shared = frames[0].lens.values if all(frame.lens == frames[0].lens for frame in frames) else None
    top: dict[str, Any] = {"camera_model": frames[0].lens.model, **(shared or {})}
    top |= {"applied_transform": applied.tolist(), **more}
    if points is not None:
        top["ply_file_path"] = points
    top["frames"] = []
    for frame in frames:
        entry: dict[str, Any] = {"file_path": f"images/{frame.name}"}
        if frame.mask is not None:
            entry["mask_path"] = f"masks/{frame.mask}"
        if frame.source is not None:
            entry["source_path"] = frame.source
        if shared is None:
            entry |= frame.lens.values
        pose = np.eye(4)
        pose[:3] = frame.pose[:3]
        entry["transform_matrix"] = pose.tolist()
        if frame.image_id is not None:
            entry["colmap_im_id"] = frame.image_id
        top["frames"].append(entry)
    return top


def write_points(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
    """Write `points` (K, 3) with `colors` (K, 3) uint8 as an ascii PLY file `path`."""
    names = [*(f"property float {axis}" for axis in "xyz"), *(f"property uint8 {c}" for c in ("red", "green", "blue"))]
    header = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *names, "end_header"]
    rows = [
        f"{x:.8g} {y:.8g} {z:.8g} {r} {g} {b}"
        for (x, y, z), (r, g, b) in zip(points.tolist(), colors.tolist(), strict=True)
    ]
    path.write_text("\n".join([*header, *rows]) + "\n", encoding="ascii")
