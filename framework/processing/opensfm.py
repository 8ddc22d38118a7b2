"""Reconstructions of OpenSfM, which OpenDroneMap keeps in the folder opensfm of a project: reconstruction.json.

Conventions are in "Geometric Models" of OpenSfM's documentation. A shot's rotation (axis times angle) and translation
lead from the world, with z up, to the camera (x right, y down, z forward). A position in an image is in units of
the image's longer side L, from its centre: u L + w / 2, where the first pixel's centre is at 0.5.
"""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from nerfloom.base.console import say
from nerfloom.base.errors import DataError, shown
from nerfloom.base.json_files import read_json
from nerfloom.processing.capture import Capture, PosedCamera, for_size_of, near_origin, relative_name
from nerfloom.processing.finite_numbers import UNUSABLE, bounded, finite_array, side
from nerfloom.processing.transforms import Lens, opengl_pose

PROGRAM = "OpenSfM"
"""Name for messages."""
PLACES = ("opensfm/reconstruction.json", "reconstruction.json")
"""Paths of the reconstruction in a project of OpenDroneMap, and in one of OpenSfM."""
PERSPECTIVE = {
    "perspective": ("k1", "k2"),
    "simple_radial": ("k1",),
    "radial": ("k1", "k2"),
    "brown": ("k1", "k2", "k3", "p1", "p2"),
}
"""Projection types that are perspective, and their coefficients, which are OpenCV's."""
FISHEYE = {"fisheye": ("k1", "k2"), "fisheye_opencv": ("k1", "k2", "k3", "k4")}
"""Projection types that are equidistant fisheyes, and their coefficients."""
SPHERICAL = ("spherical", "equirectangular")
"""Projection types of panoramas."""


def find_reconstruction(project: Path) -> Path:
    """Return the path of the reconstruction in a `project` folder of OpenDroneMap or OpenSfM.

    Raises:
        DataError: if there is none.
    """
    for place in PLACES:
        if (project / place).is_file():
            return project / place
    raise DataError(
        f"--data {project} has no opensfm/reconstruction.json; OpenDroneMap keeps it unless it runs with "
        "--optimize-disk-space"
    )


def read_capture(file: Path) -> Capture:
    """Read the reconstruction with the most shots in `file`; shots of others are not connected and left out.

    Raises:
        DataError: if the file is not such a reconstruction, or has an invalid number.
    """
    content = read_json(file)
    parts = content if isinstance(content, list) else [content]
    sizes = [len(part["shots"]) if _is_reconstruction(part) else -1 for part in parts]
    if not sizes or min(sizes) < 0:
        raise DataError(f"{file} is not a list of reconstructions with 'shots' and 'cameras'")
    largest = sizes.index(max(sizes))
    left_out = Counter({"in unconnected reconstructions": sum(sizes) - sizes[largest]})
    part = parts[largest]
    lenses: dict[str, Any] = part["cameras"]
    cameras: list[PosedCamera] = []
    for name, shot in part["shots"].items():
        where = f"{file}: shot {shown(name)}"
        camera = _camera(name, shot, lenses, where)
        if camera is None:
            left_out[f"of a camera that is not supported ({shown(_kind(lenses[shot['camera']]))})"] += 1
        else:
            cameras.append(camera)
    points, colors = _points(part.get("points"), file)
    return Capture(PROGRAM, cameras, left_out, points, colors, z_is_up=True, frame=near_origin(cameras))


def rotation_of(vector: np.ndarray) -> np.ndarray:
    """Return the rotation matrix (3, 3) of a `vector` (3,), axis times angle in radians, by Rodrigues' formula."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    half = math.sin(angle / 2) / (angle / 2) if angle > 0 else 1.0
    return np.eye(3) + np.sinc(angle / math.pi) * cross + half**2 / 2 * (cross @ cross)


def lens_of(camera: dict[str, Any], kind: str, where: str) -> Lens:
    """Return the lens of a `camera` of a supported projection `kind`, `where` in messages, for its stated size.

    Raises:
        DataError: if a number is missing or invalid.
    """
    try:
        width, height = side(camera["width"]), side(camera["height"])
    except UNUSABLE as error:
        raise DataError(f"{where} has no width and height of its images") from error
    longer = max(width, height)
    if kind in SPHERICAL:
        half = longer / 2
        return Lens(
            "EQUIRECTANGULAR", {"w": width, "h": height, "fl_x": half, "fl_y": half, "cx": width / 2, "cy": height / 2}
        )
    given = _numbers(camera, kind, where)
    values = {
        "w": width, "h": height, "fl_x": given["focal_x"] * longer, "fl_y": given["focal_y"] * longer,
        "cx": width / 2 + given["c_x"] * longer, "cy": height / 2 + given["c_y"] * longer,
    }  # fmt: skip
    coefficients = {name: given[name] for name in (PERSPECTIVE | FISHEYE)[kind]}
    return Lens("OPENCV_FISHEYE" if kind in FISHEYE else "OPENCV", values | coefficients)


def _is_reconstruction(part: Any) -> bool:
    return isinstance(part, dict) and isinstance(part.get("shots"), dict) and isinstance(part.get("cameras"), dict)


def _kind(camera: Any) -> Any:
    return camera.get("projection_type", "perspective") if isinstance(camera, dict) else None


def _camera(name: str, shot: Any, lenses: dict[str, Any], where: str) -> PosedCamera | None:
    """Return a shot's camera; None if its lens is not supported."""
    if not isinstance(shot, dict) or not isinstance(shot.get("camera"), str) or shot["camera"] not in lenses:
        raise DataError(f"{where} has no camera of this reconstruction")
    given, kind = lenses[shot["camera"]], _kind(lenses[shot["camera"]])
    rotation = rotation_of(finite_array(shot.get("rotation"), (3,), f"{where}: 'rotation'"))
    translation = finite_array(shot.get("translation"), (3,), f"{where}: 'translation'")
    if not isinstance(kind, str) or kind not in (*PERSPECTIVE, *FISHEYE, *SPHERICAL):
        return None
    lens = lens_of(given, kind, f"{where}: camera {shown(shot['camera'])}")
    pose = opengl_pose(np.concatenate([rotation, translation[:, None]], axis=1))
    return PosedCamera(relative_name(name), pose, for_size_of(lens))


def _numbers(camera: dict[str, Any], kind: str, where: str) -> dict[str, float]:
    """Return focal lengths, principal point and coefficients of a camera; missing ones are 0 or the other focal."""
    try:
        focal = camera.get("focal", camera.get("focal_x"))
        numbers = {key: bounded(camera.get(key, focal)) for key in ("focal_x", "focal_y")}
        numbers |= {key: bounded(camera.get(key, 0)) for key in ("c_x", "c_y", *(PERSPECTIVE | FISHEYE)[kind])}
    except UNUSABLE as error:
        raise DataError(f"{where} has a value that is not a number") from error
    if min(numbers["focal_x"], numbers["focal_y"]) <= 0:
        raise DataError(f"{where} has a focal length that is not above zero")
    return numbers


def _points(points: Any, file: Path) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return positions (K, 3) and colours (K, 3) of the points; None without."""
    if not isinstance(points, dict) or not points:
        say(f"{file} has no points")
        return None, None
    listed = [point if isinstance(point, dict) else {} for point in points.values()]
    shape = (len(listed), 3)
    positions = finite_array([point.get("coordinates") for point in listed], shape, f"{file}: the points' coordinates")
    colors = finite_array([point.get("color", [128] * 3) for point in listed], shape, f"{file}: the points' colours")
    return positions, colors.clip(0, 255).round().astype(np.uint8)
