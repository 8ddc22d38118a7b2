"""A street: houses with windows and signs on both sides of a road, under an open sky; large scenes in blocks learn it.

Coordinates are scene units with x along the road and z up; the ground is at height 0. Cameras drive along the road and
look ahead and to both sides. `write_street` takes photographs in nerfstudio's format, with cars that are elsewhere in
each image, and masks with the truth about them. Its file can state exposures, and poses with errors as from a device.
"""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from nerfloom.dataparsers.procedural.courtyard import masonry, tone
from nerfloom.dataparsers.procedural.photographs import Changing, lights
from nerfloom.dataparsers.procedural.scene import (
    DAYLIGHT,
    Colour,
    Light,
    Part,
    Parts,
    blend,
    displayed,
    mix,
    smoothstep,
)
from nerfloom.dataparsers.procedural.shapes import Box, Union
from nerfloom.dataparsers.procedural.views import complete_folder, in_parallel, render_view
from nerfloom.kernels.math import cross_matrix

ANGLE = math.radians(75.0)
"""Horizontal field of view of the cameras, radians."""
LOT = 3.0
"""Length of the street per pair of houses."""
ROAD, FACE = 1.0, 1.7
"""Distance of the kerb and of the nearest fronts of houses from the middle of the road."""
EYE = 0.55
"""Height of the cameras."""
YAWS = (0.0, math.radians(75.0), math.radians(-75.0))
"""Directions of the cameras in turn: ahead, to the left, to the right."""
SHUTTER, F_NUMBER, ISO = 0.01, 2.0, 100.0
"""Exposure time (s), f-number and sensitivity of images in daylight."""
_WINDOW = (0.62, 0.72)  # width and height of a cell of a front that holds a window
_CAR = Union((
    (Box((0.42, 0.19, 0.10)), (0.0, 0.0, 0.17)),
    (Box((0.22, 0.16, 0.09)), (0.0, 0.0, 0.36)),
))  # fmt: skip
_LANE, _NEAR, _GAP = 0.5, 8.0, 1.0  # distance of cars from the middle and, at most, from the camera; between cars
_MORTAR, _ZENITH, _HORIZON = (0.55, 0.52, 0.47), (0.16, 0.30, 0.52), (0.75, 0.72, 0.68)


def _plain(colour: Colour, p: Tensor) -> Tensor:
    return blend(colour, colour, p[0])


def _front(half: tuple[float, float, float], light: Colour, dark: Colour, frame: Colour, p: Tensor) -> Tensor:
    """Return bricks with rows of windows (3, R) on the walls of a house, and its roof."""
    face = (p.abs() / p.new_tensor(half)[:, None]).argmax(0)
    along, height = torch.where(face == 0, p[1], p[0]), p[2] + half[2]
    wall = masonry(light, dark, _MORTAR, (0.24, 0.1), along, height)
    column, row = (along / _WINDOW[0]).floor(), (height / _WINDOW[1]).floor()
    across = (along / _WINDOW[0] - column - 0.5).abs() * _WINDOW[0]
    up = (height / _WINDOW[1] - row - 0.5).abs() * _WINDOW[1]
    glass = blend((0.03, 0.05, 0.08), (0.30, 0.36, 0.42), tone(row, column))
    for colour, wide, high in ((p.new_tensor(frame)[:, None], 0.21, 0.25), (glass, 0.16, 0.20)):
        inside = smoothstep(wide + 0.01, wide - 0.01, across) * smoothstep(high + 0.01, high - 0.01, up)
        wall = mix(wall, colour, inside)
    return torch.where(face == 2, _plain(dark, p), wall)


def _letters(seed: float, ground: Colour, ink: Colour, p: Tensor) -> Tensor:
    """Return a sign (3, R): a row of signs of an invented alphabet, cells with or without ink."""
    column, row = (p[0] / 0.05).floor(), (p[2] / 0.05).floor()
    inked = (tone(row + seed, column) > 0.5) & (p[2].abs() < 0.1) & (column % 4 != 0)
    return blend(ground, ink, inked.to(p))


def _ground(p: Tensor) -> Tensor:
    """Return asphalt with a dashed line (3, R), kerbs, and paving."""
    aside = p[1].abs()
    asphalt = blend((0.13, 0.13, 0.14), (0.20, 0.20, 0.21), tone((p[0] / 0.2).floor(), (p[1] / 0.2).floor()))
    line = smoothstep(0.06, 0.05, aside) * smoothstep(0.31, 0.29, (p[0] / 1.2 - (p[0] / 1.2).floor() - 0.5).abs() * 1.2)
    road = mix(asphalt, asphalt.new_tensor((0.8, 0.8, 0.76))[:, None], line)
    paving = masonry((0.52, 0.48, 0.43), (0.32, 0.31, 0.30), (0.16, 0.15, 0.14), (0.4, 0.4), p[0], p[1])
    kerb = mix(road, asphalt.new_tensor((0.6, 0.6, 0.58))[:, None], smoothstep(ROAD - 0.09, ROAD - 0.08, aside))
    return mix(kerb, paving, smoothstep(ROAD, ROAD + 0.01, aside))


def street(houses: int, seed: int) -> dict[str, Part]:
    """Return the solids, none shiny, of a street by name: `houses` on each side, sizes and colours of a `seed`."""
    random, length = np.random.default_rng([seed, 10]), houses * LOT
    slab = Box((length / 2 + 2.0, FACE + 2.5, 0.05))
    parts = {"ground": Part(slab, (0.0, 0.0, -0.05), 0.0, _ground, 0.0, shadow=False)}

    def bricks() -> tuple[Colour, Colour]:
        base, level = random.uniform(0.3, 1.0, 3), random.uniform(0.35, 0.75)
        (r, g, b), share = (level * base / base.max()).tolist(), random.uniform(0.4, 0.7)
        return (r, g, b), (share * r, share * g, share * b)

    def add_house(name: str, half: tuple[float, float, float], x: float, y: float) -> None:
        frame = (0.85, 0.83, 0.78) if random.uniform() < 0.6 else (0.20, 0.13, 0.08)
        texture = partial(_front, half, *bricks(), frame)
        parts[name] = Part(Box(half), (x, y, half[2]), 0.0, texture, 0.0)

    for number in range(houses):
        x = (number + 0.5) * LOT - length / 2
        for side, sign in (("left", 1.0), ("right", -1.0)):
            half = (0.5 * (LOT - random.uniform(0.3, 0.8)), 0.8, 0.5 * random.uniform(1.5, 2.9))
            front = FACE + random.uniform(0.0, 0.25)
            add_house(f"house {side} {number}", half, x, sign * (front + half[1]))
            ground, ink = bricks()
            place = (x + random.uniform(-0.4, 0.4), sign * (front - 0.03), random.uniform(0.78, 0.95))
            if random.uniform() < 0.6:
                texture = partial(_letters, float(random.integers(1000)), ground, ink)
                parts[f"sign {side} {number}"] = Part(Box((0.5, 0.03, 0.13)), place, 0.0, texture, 0.0)
    for end, sign in (("east", 1.0), ("west", -1.0)):
        add_house(f"house {end}", (0.5, FACE + 1.7, 1.3), sign * (length / 2 + 1.2), 0.0)
    return parts


def street_poses(split: str, count: int, houses: int, seed: int) -> list[npt.NDArray[np.float64]]:
    """Return the poses (4, 4) of a split: evenly spaced along the road, ahead, to the left and to the right in turn.

    Training and validation cameras are jittered; test cameras are in the middle of the road.

    Args:
        split: train, val or test.
        count: number of cameras.
        houses: number of houses on each side.
        seed: seed of the positions.
    """
    random, length = np.random.default_rng([seed, 11, len(split)]), houses * LOT - 1.0
    jitter = random.uniform(-1, 1, (count, 3)) * (split != "test")
    poses = []
    for number, (back, aside, turn) in enumerate(jitter.tolist()):
        yaw, pitch = YAWS[number % len(YAWS)] + math.radians(8.0) * turn, math.radians(4.0)
        place = (((number + 0.5 + 0.4 * back) / count - 0.5) * length, 0.25 * aside, EYE)
        ahead = np.array([math.cos(pitch) * math.cos(yaw), math.cos(pitch) * math.sin(yaw), math.sin(pitch)])
        right = np.array([math.sin(yaw), -math.cos(yaw), 0.0])
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(right, ahead), -ahead, np.array(place)], axis=1)
        poses.append(pose)
    return poses


def measured(pose: npt.NDArray[np.float64], error: float, random: np.random.Generator) -> npt.NDArray[np.float64]:
    """Return a pose (4, 4) as a device might measure it.

    Args:
        pose: (4, 4) camera-to-world matrix.
        error: standard deviation of each coordinate of the position, scene units, and of each of the three numbers of
            a rotation (axis times angle, radians).
        random: source of the errors.
    """
    position, turn = random.normal(0.0, error, 3), random.normal(0.0, error, 3)
    found = pose.copy()
    found[:3, :3] = torch.linalg.matrix_exp(cross_matrix(torch.from_numpy(turn))).numpy() @ pose[:3, :3]
    found[:3, 3] += position
    return found


def traffic(pose: npt.NDArray[np.float64], count: int, random: np.random.Generator) -> dict[str, Part]:
    """Return up to `count` cars near the camera `pose` (4, 4), in both lanes, with `random` places and colours."""
    found: dict[str, Part] = {}
    for number in range(count):
        x, y = float(pose[0, 3]) + random.uniform(-_NEAR, _NEAR), math.copysign(_LANE, random.uniform(-1, 1))
        red, green, blue = random.uniform(0.05, 0.8, 3).tolist()
        if all(abs(x - other.centre[0]) > _GAP or y != other.centre[1] for other in found.values()):
            found[f"car {number}"] = Part(_CAR, (x, y, 0.0), 0.0, partial(_paint, (red, green, blue)), 0.3)
    return found


def _paint(colour: Colour, p: Tensor) -> Tensor:
    """Return the paint of a car (3, R), its dark windows and its tyres' shadow."""
    windows = mix(_plain(colour, p), p.new_tensor((0.04, 0.05, 0.06))[:, None], smoothstep(0.28, 0.29, p[2]))
    roof = mix(windows, _plain(colour, p), smoothstep(0.42, 0.43, p[2]))
    return mix(roof, p.new_tensor((0.03, 0.03, 0.03))[:, None], smoothstep(0.11, 0.10, p[2]))


@torch.no_grad()
def photograph(pose: npt.NDArray[np.float64], size: int, parts: Parts, lit: Light = DAYLIGHT) -> npt.NDArray[np.uint8]:
    """Return a photograph (H, W, 3) of solids under the sky.

    Args:
        pose: (4, 4) camera-to-world matrix.
        size: width and height of the image, pixels.
        parts: the solids.
        lit: the light of the image.
    """
    rgba = render_view(pose, ANGLE, size, size, geometry=False, parts=parts, lit=lit)[0] / 255.0
    return np.rint(255 * (rgba[..., :3] * rgba[..., 3:] + _sky(pose, size, lit) * (1 - rgba[..., 3:]))).astype(np.uint8)


def _sky(pose: npt.NDArray[np.float64], size: int, lit: Light) -> npt.NDArray[np.float64]:
    """Return the display colours (H, W, 3) of the sky at the centres of pixels."""
    plane = (np.arange(size) + 0.5 - size / 2) / (size / 2) * math.tan(ANGLE / 2)
    u, v = np.meshgrid(plane, -plane)
    height = (pose[2, 0] * u + pose[2, 1] * v - pose[2, 2]) / np.sqrt(u * u + v * v + 1)
    share = smoothstep(0.0, 0.7, torch.from_numpy(height.ravel()))
    return displayed(blend(_HORIZON, _ZENITH, share), lit).T.reshape(size, size, 3).numpy()


def write_street(
    folder: Path,
    *,
    houses: int,
    size: int = 200,
    counts: dict[str, int] | None = None,
    cars: int = 0,
    changing: Changing,
    pose_error: float = 0.0,
    seed: int = 0,
) -> None:
    """Write photographs of a street in nerfstudio's format, completely or not at all.

    Validation and test images are without cars and in daylight. Test images have `geometry/NAME.npz` with the exact
    depth (H, W) along the ray, inf for the sky, and the world normals (H, W, 3). With cars, each training image has a
    mask, black where a car or its shadow changes a colour. If exposures change, the file states each one.

    Args:
        folder: folder to create. If another process creates it meanwhile, its content is kept.
        houses: number of houses on each side.
        size: width and height of the images, pixels.
        counts: number of images of the splits train, val and test.
        cars: maximum number of cars near the camera of each training image.
        changing: the properties that differ between training images.
        pose_error: error of the training poses in the file, as in `measured`. Images and other poses do not change.
        seed: seed of houses, cameras, cars, light and errors. The same seed gives the same bytes.

    Raises:
        OSError: if the folder cannot be written.
    """
    counts, parts = counts or {"train": 80, "val": 8, "test": 16}, street(houses, seed)
    random, frames, jobs = np.random.default_rng([seed, 12]), list[dict[str, Any]](), list[tuple[Any, ...]]()
    errors = np.random.default_rng([seed, 13])
    with complete_folder(folder) as temporary:
        for kind in ("images", "geometry", *(("masks",) if cars else ())):
            (temporary / kind).mkdir(parents=True)
        for split, count in counts.items():
            training = split == "train"
            lit = lights(count, changing, seed) if training else [DAYLIGHT] * count
            for number, pose in enumerate(street_poses(split, count, houses, seed)):
                name, passing = f"{split}_{number:05d}.png", traffic(pose, cars, random) if training else {}
                known: dict[str, Any] = {"mask_path": f"masks/{name}"} if training and cars else {}
                known |= _exposure(lit[number]) if changing.exposure else {}
                stated = measured(pose, pose_error, errors) if training and pose_error else pose
                frames.append({"file_path": f"images/{name}", **known, "transform_matrix": stated.tolist()})
                jobs.append((temporary, frames[-1], pose, size, parts, passing, lit[number]))
        _write_transforms(temporary, size, frames, list(counts))
        in_parallel(_write_photograph, jobs, "Photographing the street")


def _exposure(lit: Light) -> dict[str, float]:
    """Return the entries of a frame for the exposure of an image; white balance leaves green unchanged."""
    return {"exposure_time": SHUTTER * lit.gains[1], "f_number": F_NUMBER, "iso": ISO}


def _write_transforms(folder: Path, size: int, frames: list[dict[str, Any]], splits: list[str]) -> None:
    names = [frame["file_path"] for frame in frames]
    lists = {f"{split}_filenames": [name for name in names if f"/{split}_" in name] for split in splits}
    content = {"camera_angle_x": ANGLE, "w": size, "h": size, **lists, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content, indent=1), encoding="utf-8")


def _write_photograph(
    folder: Path,
    frame: dict[str, Any],
    pose: npt.NDArray[np.float64],
    size: int,
    parts: Parts,
    passing: Parts,
    lit: Light,
) -> None:
    """Write an image, and its mask or its geometry."""
    clean = photograph(pose, size, parts, lit)
    shown = photograph(pose, size, {**parts, **passing}, lit) if passing else clean
    iio.imwrite(folder / frame["file_path"], shown)
    if "mask_path" in frame:
        iio.imwrite(folder / frame["mask_path"], np.where((shown != clean).any(-1), 0, 255).astype(np.uint8))
    if "/test_" in frame["file_path"]:
        depth, normals = render_view(pose, ANGLE, size, size, supersample=1, parts=parts)[1:]
        assert depth is not None
        assert normals is not None
        np.savez_compressed(folder / "geometry" / f"{Path(frame['file_path']).stem}.npz", depth=depth, normals=normals)
