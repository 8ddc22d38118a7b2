"""Solids with an exact surface: a ball, a box, a ring, a thin plate, and a box with a hole, seen from all sides.

`python -m nerfloom.dataparsers.procedural.solids FOLDER` writes images of them in NeRF-Synthetic's format, and
`reference.ply`, their surface as a mesh with exact normals. Train a method on the folder as on any other, and compare
its surface with `ns-eval RUN --reference-mesh FOLDER/reference.ply`. The solids are matte and touch nothing, so that
cameras see all of the surface.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, FlagError
from nerfloom.cli.common import run_command
from nerfloom.cli.flags import read_flags
from nerfloom.data.ply import write_columns
from nerfloom.dataparsers.procedural.scene import Colour, Part, Parts, blend, wave
from nerfloom.dataparsers.procedural.shapes import BoredBox, Box, Sphere, Torus
from nerfloom.dataparsers.procedural.triangles import Triangles, joined, of_bored_box, of_box, of_sphere, of_torus
from nerfloom.dataparsers.procedural.views import camera_pose, complete_folder, write_views

DEVIATION = 5e-5
"""Maximum distance of the reference's triangles from the surface, scene units: 0.002 % of the solids' extent."""
REFERENCE = "reference.ply"
"""Name of the mesh's file."""
_BALL, _BOX, _RING = Sphere(0.40), Box((0.30, 0.24, 0.36)), Torus(0.36, 0.13)
_PLATE, _BORED = Box((0.44, 0.016, 0.34)), BoredBox((0.32, 0.32, 0.26), 0.17)


def _cells(light: Colour, dark: Colour, size: float, p: Tensor) -> Tensor:
    """Return a checkerboard (3, R) in space with cells of edge `size` at points `p` (3, R)."""
    value = torch.ones_like(p[0])
    for axis, row in enumerate(p):
        value = value * wave(row * (math.pi / size) + 0.7 * axis + 0.3, 6.0)
    return blend(dark, light, 0.5 + 0.5 * value)


def _labyrinth(light: Colour, dark: Colour, size: float, p: Tensor) -> Tensor:
    """Return the two sides (3, R) of a gyroid of period `size` at points `p` (3, R)."""
    x, y, z = p * (2 * math.pi / size)
    value = x.sin() * y.cos() + y.sin() * z.cos() + z.sin() * x.cos()
    return blend(dark, light, 0.5 + 0.5 * (3.0 * value).clamp(-1.0, 1.0))


SOLIDS: Parts = {
    "sphere": Part(
        _BALL, (-0.58, -0.50, 0.42), 0.3, partial(_labyrinth, (0.85, 0.42, 0.30), (0.30, 0.05, 0.06), 0.21), 0.0
    ),
    "cuboid": Part(_BOX, (0.54, -0.50, -0.42), 0.45, partial(_cells, (0.90, 0.85, 0.74), (0.0, 0.2, 0.24), 0.10), 0.0),
    "torus": Part(
        _RING, (0.52, 0.46, 0.42), -0.6, partial(_labyrinth, (0.90, 0.75, 0.40), (0.45, 0.20, 0.04), 0.15), 0.0
    ),
    "plate": Part(_PLATE, (-0.54, 0.60, 0.38), 0.9, partial(_cells, (0.75, 0.80, 0.90), (0.08, 0.10, 0.35), 0.09), 0.0),
    "bored": Part(
        _BORED, (-0.50, 0.38, -0.48), 0.2, partial(_labyrinth, (0.60, 0.80, 0.55), (0.05, 0.22, 0.10), 0.17), 0.0
    ),
}
"""The solids by name."""


def surface(deviation: float = DEVIATION) -> Triangles:
    """Return the surface of all solids, by triangles at most `deviation` from it, scene units."""
    local = {
        "sphere": of_sphere(_BALL, deviation),
        "cuboid": of_box(_BOX),
        "torus": of_torus(_RING, deviation),
        "plate": of_box(_PLATE),
        "bored": of_bored_box(_BORED, deviation),
    }
    return joined([_placed(found, SOLIDS[name]) for name, found in local.items()])


def _placed(found: Triangles, part: Part) -> Triangles:
    cosine, sine = math.cos(part.yaw), math.sin(part.yaw)
    turn = torch.tensor([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]], dtype=torch.float64)
    centre = torch.tensor(part.centre, dtype=torch.float64)
    return Triangles(found.vertices @ turn.T + centre, found.normals @ turn.T, found.faces)


def poses_around(count: int, turn: float = 0.0) -> list[npt.NDArray[np.float64]]:
    """Return `count` camera-to-world matrices (4, 4) on a sphere, by a Fibonacci lattice turned by `turn` radians."""
    heights = 1 - 2 * (np.arange(count) + 0.5) / count
    azimuths = turn + math.pi * (3.0 - math.sqrt(5.0)) * np.arange(count)
    return [camera_pose(float(a), math.asin(h)) for a, h in zip(azimuths, heights, strict=True)]


def write_solids(
    folder: Path,
    size: int = 400,
    num_train: int = 100,
    num_test: int = 20,
) -> None:
    """Write images of the solids, 8 of them for validation, and `reference.ply`, completely or not at all.

    Args:
        folder: folder to create.
        size: width and height of the images, pixels.
        num_train: number of training images.
        num_test: number of test images.

    Raises:
        OSError: if the folder cannot be written.
    """
    turns = {"train": (num_train, 0.0), "val": (8, 1.0), "test": (num_test, 2.0)}
    with complete_folder(folder) as temporary:
        poses = {split: poses_around(*turn) for split, turn in turns.items()}
        write_views(temporary, poses, SOLIDS, size, "Rendering the solids")
        vertices, normals, faces = surface()
        columns = [*zip("xyz", vertices.float().numpy().T, strict=True)]
        columns += zip(("nx", "ny", "nz"), normals.float().numpy().T, strict=True)
        write_columns(temporary / REFERENCE, columns, faces)


@dataclass(frozen=True)
class SolidsFlags:
    """Write a data set of solids with an exact surface."""

    folder: Path
    """Folder to create."""
    size: int = 400
    """Width and height of the images, pixels."""
    num_train: int = 100
    """Number of training images of a scene."""
    num_test: int = 20
    """Number of test images of a scene."""


FlagsT = TypeVar("FlagsT", bound=SolidsFlags)


def flags_of(kind: type[FlagsT], name: str, arguments: list[str]) -> FlagsT:
    """Return the flags of a class `kind` from the `arguments` of the module `name` of this package, run as a program.

    Raises:
        ConfigError: if a number is out of range, or the folder exists.
    """
    if arguments and not arguments[0].startswith("-"):
        arguments = ["--folder", *arguments]
    flags: FlagsT = read_flags(kind, f"python -m nerfloom.dataparsers.procedural.{name}", arguments, takes="FOLDER")
    if min(flags.size, flags.num_train, flags.num_test) < 1:
        raise FlagError("--size, --num-train and --num-test must be at least 1")
    if flags.folder.exists():
        raise ConfigError(f"{flags.folder} exists already; name another folder")
    return flags


def _command(arguments: list[str]) -> None:
    flags = flags_of(SolidsFlags, "solids", arguments)
    write_solids(flags.folder, flags.size, flags.num_train, flags.num_test)
    say(f"{flags.folder}: images, and {REFERENCE}, their exact surface; ns-train METHOD --data {flags.folder}")


if __name__ == "__main__":
    run_command(_command)
