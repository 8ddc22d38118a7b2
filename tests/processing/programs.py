"""Files as other programs write them, of cameras and points that are known, and the programs' own projections.

Formulas are written out from the programs' manuals, in float64; nothing of the framework is used.
"""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

WIDTH, HEIGHT = 64, 48
COUNT = 5
NAMES = [f"DSC_{index:04d}.JPG" for index in range(COUNT)]
FRAME = {
    "f": 55.0, "cx": 1.5, "cy": -0.75, "b1": 0.8, "k1": -0.11, "k2": 0.03, "k3": 0.02, "k4": -0.015, "p1": 0.004,
    "p2": -0.006,
}  # fmt: skip
"""A calibration of Metashape."""
BENT = {**FRAME, "b2": -3.0, "p3": 0.4, "p4": -0.3}
"""A calibration with terms that transforms.json has no place for."""
FISHEYE = {"f": 30.0, "cx": 0.5, "cy": 1.25, "b1": -0.4, "k1": 0.05, "k2": -0.02, "k3": 0.006, "k4": -0.001}
BENT_FISHEYE = {**FISHEYE, "b2": 2.0, "p1": 0.008, "p2": -0.006, "p3": 0.3}
"""The same of a fisheye."""
ROTATION, _ = np.linalg.qr(np.random.default_rng(77).normal(size=(3, 3)))
ROTATION *= np.linalg.det(ROTATION)
CHUNK = (ROTATION, np.array([3.0, -2.0, 1.5]), 2.5)
"""Rotation, translation and scale of a chunk."""


def rotation_at(index: int) -> np.ndarray:
    """(3, 3) camera-to-world, for a camera with x right, y down, z forward."""
    q, _ = np.linalg.qr(np.random.default_rng(index).normal(size=(3, 3)))
    return q * np.linalg.det(q)


def position_at(index: int) -> np.ndarray:
    """(3,) of the camera."""
    return np.random.default_rng(100 + index).normal(size=3)


def in_view(index: int, widest: float = 0.3, count: int = 30) -> np.ndarray:
    """(count, 3) points in the frame of a camera, within an angle of its axis, radians."""
    draws = np.random.default_rng(200 + index)
    angle, around, distance = (
        draws.uniform(0.01, widest, count),
        draws.uniform(0, 6.28, count),
        draws.uniform(2, 4, count),
    )
    directions = [np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)]
    return distance[:, None] * np.stack(directions, 1)


def write_images(folder: Path, names: Sequence[str] = NAMES, size: tuple[int, int] = (WIDTH, HEIGHT)) -> Path:
    for index, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shades = np.random.default_rng(index).integers(0, 255, (size[1], size[0], 3), dtype=np.uint8)
        Image.fromarray(shades).save(folder / name)
    return folder


def numbers(values: Any) -> str:
    return " ".join(repr(float(value)) for value in np.asarray(values).reshape(-1))


# -- Metashape ------------------------------------------------------------------------------------------------------


def sensor(
    number: int, kind: str, calibration: dict[str, float] | None, size: tuple[int, int] = (WIDTH, HEIGHT)
) -> str:
    resolution = f'<resolution width="{size[0]}" height="{size[1]}"/>'
    inside = "".join(f"<{name}>{value!r}</{name}>" for name, value in (calibration or {}).items())
    calibrated = f'<calibration type="{kind}" class="adjusted">{resolution}{inside}</calibration>'
    return (
        f'<sensor id="{number}" label="lens {number}" type="{kind}">{resolution}'
        f'<property name="layer_index" value="0"/>{"" if calibration is None else calibrated}</sensor>'
    )


def camera(index: int, label: str, sensor_id: int = 0, more: str = "", placed: bool = True) -> str:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation_at(index), position_at(index)
    inside = f"<transform>{numbers(matrix)}</transform><orientation>1</orientation>" if placed else ""
    return f'<camera id="{index}" sensor_id="{sensor_id}" label="{label}" {more}>{inside}</camera>'


def transform(similarity: tuple[np.ndarray, np.ndarray, float] = CHUNK) -> str:
    rotation, translation, scale = similarity
    return (
        f'<transform><rotation locked="false">{numbers(rotation)}</rotation><translation locked="false">'
        f'{numbers(translation)}</translation><scale locked="true">{scale!r}</scale></transform>'
    )


def document(sensors: str, cameras: str, more: str = "") -> str:
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0">\n<chunk label="Chunk 1" enabled="true">\n'
        f'<sensors next_id="9">{sensors}</sensors>\n<cameras next_id="99" next_group_id="1">{cameras}</cameras>\n'
        f"{more}</chunk>\n</document>\n"
    )


def write_metashape(folder: Path) -> Path:
    """Photographs and cameras.xml; labels have no ending, as by default."""
    write_images(folder / "photographs")
    cameras = "".join(camera(index, Path(name).stem) for index, name in enumerate(NAMES))
    (folder / "cameras.xml").write_text(document(sensor(0, "frame", FRAME), cameras, transform()), encoding="utf-8")
    return folder


def metashape_pixels(local: np.ndarray, c: dict[str, float], fisheye: bool) -> np.ndarray:
    """(K, 2) by the manual's appendix, of points in the camera's frame."""
    k1, k2, k3, k4, p1, p2, b1, b2 = (c.get(name, 0.0) for name in ("k1", "k2", "k3", "k4", "p1", "p2", "b1", "b2"))
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    if fisheye:
        r0 = np.hypot(x, y)
        x, y = x * np.arctan(r0) / r0, y * np.arctan(r0) / r0
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    more = 1 + c.get("p3", 0.0) * r2 + c.get("p4", 0.0) * r2**2
    bent_x = x * radial + (p1 * (r2 + 2 * x * x) + 2 * p2 * x * y) * more
    bent_y = y * radial + (p2 * (r2 + 2 * y * y) + 2 * p1 * x * y) * more
    u = WIDTH * 0.5 + c["cx"] + bent_x * c["f"] + bent_x * b1 + bent_y * b2
    return np.stack([u, HEIGHT * 0.5 + c["cy"] + bent_y * c["f"]], 1)


def to_world(index: int, local: np.ndarray, similarity: tuple[np.ndarray, np.ndarray, float] = CHUNK) -> np.ndarray:
    """(K, 3) in the world of Metashape: through the camera's transform, then the chunk's."""
    rotation, translation, scale = similarity
    return (local @ rotation_at(index).T + position_at(index)) * scale @ rotation.T + translation


# -- RealityCapture -------------------------------------------------------------------------------------------------

ANGLES = [(170.3, 85.2, -22.7), (0.0, 0.0, 0.0), (-35.0, 60.0, 5.0), (90.0, 90.0, 0.0), (271.0, 20.0, 140.0)]
"""heading, pitch and roll, degrees."""
BROWN = {"px": -0.0071, "py": 0.0031, "k1": 0.03, "k2": -0.04, "k3": 0.018, "k4": -0.006, "t1": 0.003, "t2": -0.005}
FILM = 24.5


def write_realitycapture(folder: Path, recent: bool = False) -> Path:
    """Photographs and cameras.csv, with RealityCapture's or RealityScan's names of columns."""
    write_images(folder / "photographs")
    heads = ("yaw", "f_35mm", "px_norm", "py_norm") if recent else ("heading", "f", "px", "py")
    lines = [f"#name,x,y,alt,{heads[0]},pitch,roll,{','.join(heads[1:])},k1,k2,k3,k4,t1,t2"]
    for index, name in enumerate(NAMES):
        values = [*position_at(index), *ANGLES[index], FILM, *BROWN.values()]
        lines.append(f"{name},{','.join(repr(float(value)) for value in values)}")
    (folder / "cameras.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder


def realitycapture_pixels(local: np.ndarray) -> np.ndarray:
    """(K, 2) of points in the camera's frame (x right, y down): t1 is with r^2 + 2 x^2."""
    c = BROWN
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    r2 = x * x + y * y
    radial = 1 + c["k1"] * r2 + c["k2"] * r2**2 + c["k3"] * r2**3 + c["k4"] * r2**4
    u = x * radial + c["t1"] * (r2 + 2 * x * x) + 2 * c["t2"] * x * y
    v = y * radial + c["t2"] * (r2 + 2 * y * y) + 2 * c["t1"] * x * y
    scale = max(WIDTH, HEIGHT)
    focal = FILM / 36 * scale
    return np.stack([focal * u + c["px"] * scale + 0.5 * WIDTH, focal * v + c["py"] * scale + 0.5 * HEIGHT], 1)


def realitycapture_world(index: int, local: np.ndarray) -> np.ndarray:
    """(K, 3): the camera looks down at first (right is east, up in the image is north); then roll, pitch, heading."""
    heading, pitch, roll = np.radians(ANGLES[index])
    east, north, up = local[:, 0], -local[:, 1], -local[:, 2]
    east, up = east * np.cos(roll) + up * np.sin(roll), up * np.cos(roll) - east * np.sin(roll)
    north, up = north * np.cos(pitch) - up * np.sin(pitch), north * np.sin(pitch) + up * np.cos(pitch)
    east, north = east * np.cos(heading) + north * np.sin(heading), north * np.cos(heading) - east * np.sin(heading)
    return np.stack([east, north, up], 1) + position_at(index)


# -- OpenSfM --------------------------------------------------------------------------------------------------------

OPENSFM: dict[str, dict[str, float]] = {
    "perspective": {"focal": 0.9, "k1": -0.1, "k2": 0.03},
    "brown": {
        "focal_x": 0.9, "focal_y": 0.91, "c_x": 0.01, "c_y": -0.02, "k1": -0.1, "k2": 0.03, "k3": 0.01, "p1": 0.002,
        "p2": -0.003,
    },
    "fisheye": {"focal": 0.5, "k1": -0.05, "k2": 0.02},
    "fisheye_opencv": {
        "focal_x": 0.5, "focal_y": 0.51, "c_x": 0.01, "c_y": -0.02, "k1": -0.05, "k2": 0.02, "k3": 0.01, "k4": -0.002,
    },
    "spherical": {},
}  # fmt: skip
"""Projection type -> numbers of a camera."""


def write_odm(folder: Path, kind: str = "brown", size: tuple[int, int] = (WIDTH, HEIGHT)) -> Path:
    """A project of OpenDroneMap; its camera states another size, as it was found on reduced images."""
    write_images(folder / "images", size=size)
    name = f"v2 dji fc6310r {size[0] * 4} {size[1] * 4} {kind} 0.6666"
    lens = {"projection_type": kind, "width": size[0] * 2, "height": size[1] * 2, **OPENSFM[kind]}
    shots = {}
    for index, image in enumerate(NAMES):
        turn = rotation_at(index).T  # world to camera
        angle = math.acos((np.trace(turn) - 1) / 2)
        axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        vector = axis / (2 * math.sin(angle)) * angle
        shots[image] = {
            "rotation": vector.tolist(), "translation": (-turn @ position_at(index)).tolist(), "camera": name,
            "orientation": 1, "gps_dop": 15.0,
        }  # fmt: skip
    points = {str(i): {"color": [10.0 * i, 20.0, 255.0], "coordinates": [0.5 * i, 1.0, -2.0]} for i in range(4)}
    small = {"cameras": {name: lens}, "shots": {"other.JPG": shots[NAMES[0]]}, "points": {}}
    content = [{"cameras": {name: lens}, "shots": shots, "points": points}, small]
    (folder / "opensfm").mkdir(parents=True, exist_ok=True)
    (folder / "opensfm" / "reconstruction.json").write_text(json.dumps(content))
    return folder


def opensfm_pixels(local: np.ndarray, kind: str, size: tuple[int, int] = (WIDTH, HEIGHT)) -> np.ndarray:
    """(K, 2) by the documentation's formulas: normalised coordinates times the longer side, from the centre."""
    c, (x, y, z), longer = OPENSFM[kind], local.T, max(size)
    if kind == "spherical":
        u = np.arctan2(x, z) / (2 * np.pi)
        v = -np.arctan2(-y, np.hypot(x, z)) / (2 * np.pi)
    else:
        focal_x, focal_y = c.get("focal_x", c.get("focal", 0.0)), c.get("focal_y", c.get("focal", 0.0))
        k1, k2, k3, k4, p1, p2 = (c.get(name, 0.0) for name in ("k1", "k2", "k3", "k4", "p1", "p2"))
        xn, yn = x / z, y / z
        if kind.startswith("fisheye"):
            r = np.hypot(x, y)
            theta = np.arctan2(r, z)
            xn, yn = theta * x / r, theta * y / r
        r2 = xn * xn + yn * yn
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
        u = focal_x * (radial * xn + 2 * p1 * xn * yn + p2 * (r2 + 2 * xn * xn)) + c.get("c_x", 0.0)
        v = focal_y * (radial * yn + 2 * p2 * xn * yn + p1 * (r2 + 2 * yn * yn)) + c.get("c_y", 0.0)
    return np.stack([u * longer + size[0] / 2, v * longer + size[1] / 2], 1)


# -- Bundler --------------------------------------------------------------------------------------------------------

BUNDLE = (60.0, -0.08, 0.02)
"""f, k1 and k2."""


def write_bundler(folder: Path) -> Path:
    """Photographs, bundle.out with one camera that was not placed, and list.txt with focal lengths."""
    write_images(folder / "photographs")
    lines = ["# Bundle file v0.3", f"{COUNT + 1} 2"]
    for index in range(COUNT):
        turn = np.diag([1.0, -1, -1]) @ rotation_at(index).T
        lines += [numbers(BUNDLE), *(numbers(row) for row in turn), numbers(-turn @ position_at(index))]
    lines += ["0 0 0", *["0 0 0"] * 3, "0 0 0"]
    lines += ["0.5 -1.5 2.25", "255 10 0", "1 0 7 1.5 -2.5", "1 2 3", "0 0 255", "0"]
    (folder / "bundle.out").write_text("\n".join(lines) + "\n")
    listed = [f"./{name} 0 1234.5" if index % 2 else f"./{name}" for index, name in enumerate([*NAMES, "lost.JPG"])]
    (folder / "list.txt").write_text("\n".join(listed) + "\n")
    return folder


def bundler_pixels(local: np.ndarray) -> np.ndarray:
    """(K, 2) by the manual's formulas, of points in the camera's frame with x right, y down, z forward."""
    focal, k1, k2 = BUNDLE
    camera_frame = local * [1, -1, -1]
    p = -camera_frame[:, :2] / camera_frame[:, 2:]
    r2 = np.square(p).sum(1, keepdims=True)
    centred = focal * (1 + k1 * r2 + k2 * r2**2) * p
    return np.stack([WIDTH / 2 + centred[:, 0], HEIGHT / 2 - centred[:, 1]], 1)


def in_world(index: int, local: np.ndarray) -> np.ndarray:
    """(K, 3) in the world of cameras with the poses `rotation_at` and `position_at`."""
    return local @ rotation_at(index).T + position_at(index)
