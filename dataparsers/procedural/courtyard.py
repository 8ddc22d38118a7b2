"""A courtyard: the embedded scene's solids on paving between brick walls, so that every pixel shows a surface.

Coordinates are scene units with z up, and everything lies within `HALF` of the origin. Cameras stand inside and look at
the middle. Photographs of it, with people in them and in changing light, are written by `photographs.py`.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from nerfloom.dataparsers.procedural.scene import PARTS, Colour, Part, Parts, blend, mix, smoothstep
from nerfloom.dataparsers.procedural.shapes import Box
from nerfloom.dataparsers.procedural.views import camera_pose

HALF = 4.0
"""Half the side of the cube around the origin that holds the courtyard."""
GROUND = -0.61
"""Height of the ground."""
WALL = 3.9
"""Distance of the walls' faces from the middle."""
_HEIGHT, _THICK = 3.1, 0.05
_MIDDLE = GROUND + _HEIGHT / 2


def tone(row: Tensor, column: Tensor) -> Tensor:
    """Return a number in [0, 1) for each cell, given by `row` and `column`, hardly related between neighbours."""
    return (12.9898 * row + 78.233 * column).sin().mul(437.5453).frac().abs()


def masonry(light: Colour, dark: Colour, joint: Colour, size: tuple[float, float], u: Tensor, v: Tensor) -> Tensor:
    """Return cells (3, R) of width and height `size` in rows that are shifted by half a cell, with joints between.

    Args:
        light, dark: extreme colours of cells.
        joint: colour of the joints.
        size: width and height of a cell.
        u, v: (R,) coordinates along and across the rows.
    """
    row = (v / size[1]).floor()
    across = u / size[0] + 0.5 * (row % 2)
    column = across.floor()
    cell = blend(dark, light, tone(row, column))
    from_edge = torch.minimum(
        (0.5 - (across - column - 0.5).abs()) * size[0], (0.5 - (v / size[1] - row - 0.5).abs()) * size[1]
    )
    return mix(cell.new_tensor(joint)[:, None], cell, smoothstep(0.008, 0.02, from_edge))


def _bricks(light: Colour, dark: Colour, along: int, p: Tensor) -> Tensor:
    return masonry(light, dark, (0.55, 0.52, 0.47), (0.36, 0.16), p[along], p[2])


def _paving(p: Tensor) -> Tensor:
    return masonry((0.52, 0.47, 0.40), (0.26, 0.25, 0.24), (0.12, 0.11, 0.10), (0.42, 0.42), p[0], p[1])


def _wall(axis: int, sign: int, light: Colour, dark: Colour) -> Part:
    """Return the wall across an axis, on its negative or positive side."""
    half = [HALF, HALF, _HEIGHT / 2]
    centre = [0.0, 0.0, _MIDDLE]
    half[axis], centre[axis] = _THICK, sign * (WALL + _THICK)
    shape, texture = Box((half[0], half[1], half[2])), partial(_bricks, light, dark, 1 - axis)
    return Part(shape, (centre[0], centre[1], centre[2]), 0.0, texture, 0.0, shadow=False)


COURTYARD: Parts = {
    **PARTS,
    "ground": Part(Box((HALF, HALF, _THICK)), (0.0, 0.0, GROUND - _THICK), 0.0, _paving, 0.0, shadow=False),
    "wall east": _wall(0, 1, (0.62, 0.26, 0.17), (0.36, 0.12, 0.08)),
    "wall west": _wall(0, -1, (0.66, 0.58, 0.40), (0.42, 0.34, 0.20)),
    "wall north": _wall(1, 1, (0.40, 0.46, 0.54), (0.18, 0.22, 0.30)),
    "wall south": _wall(1, -1, (0.50, 0.56, 0.40), (0.24, 0.30, 0.18)),
}
"""The solids by name. Ground and walls cast no shadow."""


def courtyard_poses(split: str, count: int, seed: int) -> list[npt.NDArray[np.float64]]:
    """Return the poses of a split: cameras inside the walls that look at the middle.

    Training and validation cameras stand at random around it, from 10 to 40 degrees above the horizon; test cameras
    circle once while their elevation oscillates.

    Args:
        split: train, val or test.
        count: number of cameras.
        seed: seed of the positions.
    """
    random = np.random.default_rng([seed, len(split)])
    turns = np.arange(count) / count
    if split == "test":
        around, raised, away = 2 * math.pi * turns, 25 + 12 * np.sin(4 * math.pi * turns), np.full(count, 3.5)
    else:
        around = 2 * math.pi * (turns + random.uniform(0, 1) + random.uniform(-0.4, 0.4, count) / count)
        raised, away = random.uniform(10, 40, count), random.uniform(3.1, 3.7, count)
    return [camera_pose(*map(float, (a, math.radians(e), r))) for a, e, r in zip(around, raised, away, strict=True)]
