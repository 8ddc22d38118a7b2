"""Points in PLY files (Turk 1994), ascii or binary, with any other properties."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from torch import Tensor

from framework.base.errors import DataError

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
"""PLY's names of types, old and new, to numpy's."""
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
"""PLY's formats, to numpy's prefixes of byte order."""
LONGEST_HEADER = 1000
"""Maximum number of lines of a header."""
LONGEST_LINE = 1000
"""Maximum number of bytes of a line of the header."""


def read_points(file: Path) -> Tensor:
    """Read the positions of the vertices (K, 3), float64; those that are not finite are left out.

    The memory allocated is bounded by the size of the file, whatever count its header claims.

    Args:
        file: path of the PLY file.

    Raises:
        DataError: if the file cannot be read, is not a PLY file, lacks positions or is truncated.
    """
    try:
        with file.open("rb") as stream:
            order, count, columns = _header(stream, file)
            return _positions(stream, file, order, count, columns)
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror}") from error


def _header(stream: BinaryIO, file: Path) -> tuple[str, int, list[tuple[str, str]]]:
    """Return the key of `ORDERS`, the number of vertices, and the name and numpy type of each of their properties."""
    if stream.readline(LONGEST_LINE).strip() != b"ply":
        raise DataError(f"{file} is not a PLY file: its first line is not 'ply'")
    order, count, element = "", -1, ""
    columns: list[tuple[str, str]] = []
    for _ in range(LONGEST_HEADER):
        words = stream.readline(LONGEST_LINE).decode("ascii", "replace").split()
        if words[:1] == ["end_header"]:
            break
        if words[:1] == ["format"] and len(words) > 1:
            order = words[1]
        elif words[:1] == ["element"] and len(words) == 3:
            element = words[1]
            if element == "vertex" and words[2].isdecimal() and len(words[2]) < 19:
                count = int(words[2])
            elif count < 0 and words[2] != "0":
                raise DataError(
                    f"{file}: vertices must be the first element, with their number; '{element}' comes first"
                )
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in TYPES:
                raise DataError(
                    f"{file}: property '{' '.join(words[1:])}' of the vertices is not supported; it must be a number"
                )
            columns.append((words[2], TYPES[words[1]]))
    else:
        raise DataError(f"{file} is not a PLY file: its header has no 'end_header'")
    names = [name for name, _ in columns]
    if order not in ORDERS:
        raise DataError(f"{file}: its format is '{order}'; known: {', '.join(ORDERS)}")
    if count < 0 or not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names):
        raise DataError(f"{file}: vertices must have the properties x, y and z, each once")
    return order, count, columns


def _positions(stream: BinaryIO, file: Path, order: str, count: int, columns: list[tuple[str, str]]) -> Tensor:
    start = stream.tell()
    remaining = file.stat().st_size - start
    row = np.dtype([(name, ORDERS[order] + kind) for name, kind in columns])
    smallest = 2 * len(columns) if order == "ascii" else row.itemsize  # a digit and a separator
    if count * smallest > remaining + 1:
        raise DataError(f"{file} is truncated: its header states {count} points, and {remaining} bytes follow")
    if order == "ascii":
        axes = _ascii_axes(stream, file, count, [name for name, _ in columns])
    else:
        table = np.fromfile(file, row, count, offset=start)
        axes = [table[axis].astype(np.float64) for axis in "xyz"]
    points = torch.from_numpy(np.stack(axes, axis=-1))
    return points[points.isfinite().all(-1)]


def _ascii_axes(stream: BinaryIO, file: Path, count: int, names: list[str]) -> list[np.ndarray]:
    """Return the coordinates x, y and z, (count,) each."""
    columns = [names.index(axis) for axis in "xyz"]
    points = np.empty((3, count))
    for index in range(count):
        words = stream.readline().split()
        if len(words) < len(names):
            raise DataError(f"{file}: point {index} has {len(words)} values instead of {len(names)}")
        try:
            points[:, index] = [float(words[column]) for column in columns]
        except ValueError as error:
            raise DataError(f"{file}: a value of point {index} is not a number") from error
    return list(points)


def write_points(file: Path, positions: Tensor, colors: Tensor, normals: Tensor | None = None) -> None:
    """Write points to a binary PLY file.

    Args:
        file: path of the PLY file.
        positions: (K, 3).
        colors: (K, 3) in [0, 1].
        normals: (K, 3) unit vectors, or None.

    Raises:
        OSError: if the file cannot be written.
    """
    columns: list[tuple[str, str, str, np.ndarray]] = []
    for names, values in (("xyz", positions), (("nx", "ny", "nz"), normals)):
        if values is not None:
            columns += [(n, "float", "<f4", v) for n, v in zip(names, values.numpy().T, strict=True)]
    stored = (colors.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    columns += [(n, "uchar", "u1", v) for n, v in zip(("red", "green", "blue"), stored.T, strict=True)]
    table = np.empty(len(positions), [(name, kind) for name, _, kind, _ in columns])
    for name, _, _, column in columns:
        table[name] = column
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    header += [f"property {called} {name}" for name, called, _, _ in columns]
    with file.open("wb") as stream:
        stream.write(("\n".join([*header, "end_header"]) + "\n").encode())
        stream.write(table.tobytes())
