"""The file of a scene in blocks, NAME.blocks.yml or blocks.yml: plain YAML. This module does not import torch.

    version: 1
    box: [[x, y, z], [x, y, z]]      corners of the scene's region of interest, scene units
    near, far: 0.05, 1000.0          distances from a camera where the scene starts and ends, scene units
    blocks:
    - run: runs/000/nerfacto/run     folder of the run, relative to the file's folder
      center: [x, y, z]              in the input's frame and unit, as is the radius
      radius: 25.0
      cameras: [0, 1, 2]             indices of its training images
      color: [[1, 0, 0, 0], ...]     affine function of its colours, 3 x 4

dataparser_transforms.json beside the file has the scene's frame.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from nerfloom.base.atomic import write_atomically
from nerfloom.base.errors import DataError, printable, shown
from nerfloom.base.plain import read_yaml
from nerfloom.blocks.block import IDENTITY, Affine, TrainedBlock, Vector

NAME = "blocks.yml"
"""Name of the file in the folder of a scene in blocks."""
VERSION = 1
"""Version of the format."""
MAX_BLOCKS = 100_000
"""Maximum number of blocks of a file."""
MAX_NUMBER = 1e12
"""Maximum magnitude of a number in a file."""


@dataclass(frozen=True)
class BlockList:
    """The content of a file: a scene, and its blocks."""

    box: tuple[Vector, Vector]
    """Minimum and maximum corner of the region of interest, scene units."""
    near: float
    """Distance from a camera where the scene starts, scene units."""
    far: float
    """Distance from a camera where the scene ends, scene units."""
    blocks: tuple[TrainedBlock, ...]
    """The blocks, at least one."""


def is_blocks_file(path: Path) -> bool:
    """Return whether `path` names the file of a scene in blocks, by its name."""
    return path.name == NAME or path.name.endswith(f".{NAME}")


def write_blocks(file: Path, content: BlockList) -> None:
    """Write a `file` of a scene in blocks, `content`. Runs below the file's folder are named relative to it.

    Raises:
        OSError: if the file cannot be written.
    """
    document = {
        "version": VERSION,
        "box": [list(corner) for corner in content.box],
        "near": content.near,
        "far": content.far,
        "blocks": [
            {
                "run": _relative(block.run, file.parent),
                "center": list(block.center),
                "radius": block.radius,
                "cameras": list(block.cameras),
                "color": [list(row) for row in block.color],
            }
            for block in content.blocks
        ],
    }
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=120)
    write_atomically(file, lambda stream: stream.write(text.encode()))


def _relative(run: Path, folder: Path) -> str:
    run, folder = run.absolute(), folder.absolute()
    return run.relative_to(folder).as_posix() if run.is_relative_to(folder) else str(run)


def read_blocks(file: Path) -> BlockList:
    """Read the `file` of a scene in blocks.

    Raises:
        ConfigError: if the file is missing or is not YAML.
        DataError: if it holds something else, or a value is invalid.
    """
    values = read_yaml(file)
    if values.get("version") != VERSION:
        raise DataError(
            f"{file} has version {shown(values.get('version'))} of the format, and {VERSION} is known; write it again "
            "with ns-blocks"
        )
    listed, box = values.get("blocks"), values.get("box")
    if not isinstance(listed, list) or not 1 <= len(listed) <= MAX_BLOCKS:
        raise DataError(f"{file}: 'blocks' is {shown(listed)}; it must list 1 to {MAX_BLOCKS} blocks")
    if not isinstance(box, list) or len(box) != 2:
        raise DataError(f"{file}: 'box' is {shown(box)}; it must be two corners of three numbers")
    low, high = (_vector(corner, "box", str(file)) for corner in box)
    near, far = (_number(values.get(name), name, str(file)) for name in ("near", "far"))
    if not 0 <= near < far or not all(one < other for one, other in zip(low, high, strict=True)):
        raise DataError(f"{file}: near {near:g} must be at least 0 and less than far {far:g}, and the box not empty")
    blocks = [_block(values, f"{file}: block {number}", file.parent) for number, values in enumerate(listed)]
    return BlockList((low, high), near, far, tuple(blocks))


def _block(values: Any, where: str, folder: Path) -> TrainedBlock:
    if not isinstance(values, dict):
        raise DataError(f"{where} is {shown(values)}; it must hold keys and values, such as 'run: FOLDER'")
    run, cameras = values.get("run"), values.get("cameras")
    if not isinstance(run, str) or not run or "\0" in run:
        raise DataError(f"{where}: 'run' is {shown(run)}; it must be the folder of a run")
    if not os.path.isdir(folder / run):
        missing = printable(str(folder / run))
        raise DataError(f"{where}: its run {missing} does not exist; restore it, or run ns-blocks again")
    if not isinstance(cameras, list) or not all(type(index) is int and 0 <= index < 2**63 for index in cameras):
        raise DataError(f"{where}: 'cameras' is {shown(cameras)}; it must list indices of training images")
    radius = _number(values.get("radius"), "radius", where)
    if radius <= 0:
        raise DataError(f"{where}: 'radius' is {radius:g}; it must be above zero")
    center = _vector(values.get("center"), "center", where)
    return TrainedBlock(center, radius, tuple(cameras), folder / run, _color(values.get("color", IDENTITY), where))


def _color(value: Any, where: str) -> Affine:
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise DataError(f"{where}: 'color' is {shown(value)}; it must be three rows of four numbers")
    return tuple(tuple(_numbers(row, 4, "color", where)) for row in value)


def _vector(value: Any, name: str, where: str) -> Vector:
    x, y, z = _numbers(value, 3, name, where)
    return x, y, z


def _numbers(value: Any, count: int, name: str, where: str) -> list[float]:
    if not isinstance(value, list | tuple) or len(value) != count:
        raise DataError(f"{where}: '{name}' holds {shown(value)}; it must be {count} numbers")
    return [_number(part, name, where) for part in value]


def _number(value: Any, name: str, where: str) -> float:
    """Return a finite number; YAML 1.1 reads 1e-3 as a text."""
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not abs(number) <= MAX_NUMBER:
        raise DataError(f"{where}: '{name}' is {shown(value)}; it must be a number of at most {MAX_NUMBER:g}")
    return number
