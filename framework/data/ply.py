"""Vertices in PLY files (Turk 1994), ascii or binary: positions and other columns. Triangles are only written."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.atomic import write_atomically
from nerfloom.base.console import say
from nerfloom.base.errors import DataError
from nerfloom.base.lfs import ADVICE, is_pointer
from nerfloom.geometry.local_origin import local_origin, rounding

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
"""PLY's names of types, old and new, to numpy's."""
NAMES = {"uint8": "uchar", "float32": "float", "float64": "double"}
"""numpy's types that are written, to PLY's names of them."""
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
"""PLY's formats, to numpy's prefixes of byte order."""
MAX_HEADER_LENGTH = 1000
"""Maximum number of lines of a header."""
MAX_LINE_LENGTH = 1000
"""Maximum number of bytes of a line of the header."""


@dataclass(frozen=True)
class PlyElement:
    """The rows of one element of a PLY file, such as its vertices."""

    order: str
    """Key of `ORDERS`."""
    count: int
    """Number of rows that the header claims."""
    columns: list[tuple[str, str]]
    """Name and numpy type of each property, in the file's order."""
    start: int
    """Position of the first row in the file, bytes."""

    @property
    def names(self) -> list[str]:
        """Names of the properties."""
        return [name for name, _ in self.columns]

    def row(self) -> np.dtype:
        """Return the type of a row of a binary file."""
        return np.dtype([(name, ORDERS[self.order] + kind) for name, kind in self.columns])


@dataclass(frozen=True)
class PlyHeader:
    """The header of a PLY file."""

    elements: dict[str, PlyElement]
    """Elements with a known place in the file, by name: all up to the first with lists or, in ascii, the first with
    rows."""
    first: str
    """Name of the first element; empty if there is none."""
    comments: list[str]
    """Text of the comments."""


def read_points(file: Path) -> Tensor:
    """Read the vertices (K, 3) float64 of a PLY `file`; vertices that are not finite are left out, and counted.

    Raises:
        DataError: if the file cannot be read, is not a PLY file, lacks positions or is truncated.
    """
    columns = read_columns(file, vertices(file, read_header(file)), "xyz")
    points = torch.from_numpy(np.stack([column.astype(np.float64) for column in columns], axis=-1))
    finite = points.isfinite().all(-1)
    if not bool(finite.all()):
        say(f"{file}: {int((~finite).sum()):,} of {len(points):,} points are not finite and left out")
    return points[finite]


def read_header(file: Path) -> PlyHeader:
    """Read the header of a PLY `file`.

    Raises:
        DataError: if the file cannot be read or is not a PLY file.
    """
    with _opened(file) as stream:
        return _header(stream, file)


def vertices(file: Path, header: PlyHeader) -> PlyElement:
    """Return the vertices of a PLY `file` with this `header`, which have positions.

    Raises:
        DataError: if there are none, or they lack positions.
    """
    found = header.elements.get("vertex")
    if found is None:
        raise DataError(f"{file}: vertices must be the first element, with their number; '{header.first}' comes first")
    if not {"x", "y", "z"} <= set(found.names):
        raise DataError(f"{file}: vertices must have the properties x, y and z, each once")
    return found


def read_columns(file: Path, element: PlyElement, names: Sequence[str]) -> list[np.ndarray]:
    """Read properties of an element, (count,) each: in the file's type from a binary file, float64 from an ascii one.

    The memory allocated is bounded by the size of the file, for any count in its header.

    Args:
        file: path of the PLY file.
        element: the element.
        names: properties that it has.

    Raises:
        DataError: if the file cannot be read or is truncated.
    """
    with _opened(file) as stream:
        remaining, row = file.stat().st_size - element.start, element.row()
        ascii_ = element.order == "ascii"
        # In ascii at least a digit and a separator, and the last may be missing.
        needed = 2 * len(element.columns) * element.count - 1 if ascii_ else row.itemsize * element.count
        if needed > remaining:
            raise DataError(
                f"{file} is truncated: its header states {element.count} points, and {max(remaining, 0)} bytes follow"
            )
        if ascii_:
            stream.seek(element.start)
            return _ascii_columns(stream, file, element, names)
        table = np.fromfile(stream, row, element.count, offset=element.start)
        if len(table) < element.count:
            raise DataError(f"{file} is truncated: {len(table)} of {element.count} points could be read")
        return [table[name] for name in names]


@contextmanager
def _opened(file: Path) -> Iterator[BinaryIO]:
    try:
        with file.open("rb") as stream:
            yield stream
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror}") from error


def _header(stream: BinaryIO, file: Path) -> PlyHeader:
    if stream.readline(MAX_LINE_LENGTH).strip() != b"ply":
        reason = ADVICE if is_pointer(file) else "its first line is not 'ply'"
        raise DataError(f"{file} is not a PLY file: {reason}")
    order, comments = "", []
    described: list[tuple[str, int, list[tuple[str, str]]]] = []
    for _ in range(MAX_HEADER_LENGTH):
        words = stream.readline(MAX_LINE_LENGTH).decode("ascii", "replace").split()
        if words[:1] == ["end_header"]:
            break
        if words[:1] == ["format"] and len(words) > 1:
            order = words[1]
        elif words[:1] == ["comment"]:
            comments.append(" ".join(words[1:]))
        elif words[:1] == ["element"]:
            described.append((" ".join(words[1:2]), _count(words), []))
        elif words[:1] == ["property"] and described:
            number = len(words) == 3 and words[1] in TYPES
            described[-1][2].append((words[2], TYPES[words[1]]) if number else (" ".join(words[1:]), ""))
    else:
        raise DataError(f"{file} is not a PLY file: its header has no 'end_header'")
    if order not in ORDERS:
        raise DataError(f"{file}: its format is '{order}'; known: {', '.join(ORDERS)}")
    first = described[0][0] if described else ""
    return PlyHeader(_placed(file, order, described, stream.tell()), first, comments)


def _count(words: list[str]) -> int:
    """Return the number of an element's rows, -1 if the line does not say it."""
    return int(words[2]) if len(words) == 3 and words[2].isdecimal() and len(words[2]) < 19 else -1


def _placed(
    file: Path, order: str, described: list[tuple[str, int, list[tuple[str, str]]]], start: int
) -> dict[str, PlyElement]:
    """Return the elements with a known place in the file, by name."""
    elements: dict[str, PlyElement] = {}
    for name, count, columns in described:
        wrong = [column for column, kind in columns if not kind]
        twice = len({column for column, _ in columns}) < len(columns)
        if name == "vertex" and count >= 0 and wrong:
            raise DataError(f"{file}: property '{wrong[0]}' of the vertices is not supported; it must be a number")
        if name == "vertex" and count >= 0 and twice:
            raise DataError(f"{file}: vertices must have the properties x, y and z, each once")
        if count < 0 or wrong or twice or name in elements:
            break
        elements[name] = PlyElement(order, count, columns, start)
        if order == "ascii" and count:
            break
        start += elements[name].row().itemsize * count
    return elements


def _ascii_columns(stream: BinaryIO, file: Path, element: PlyElement, names: Sequence[str]) -> list[np.ndarray]:
    places = [element.names.index(name) for name in names]
    values = np.empty((len(names), element.count))
    for index in range(element.count):
        words = stream.readline().split()
        if len(words) < len(element.columns):
            raise DataError(f"{file}: point {index} has {len(words)} values instead of {len(element.columns)}")
        try:
            values[:, index] = [float(words[place]) for place in places]
        except ValueError as error:
            raise DataError(f"{file}: a value of point {index} is not a number") from error
    return list(values)


def write_points(file: Path, positions: Tensor, colors: Tensor, normals: Tensor | None = None) -> None:
    """Write points to a binary PLY file: positions as float, or as double where float would be too coarse.

    Args:
        file: path of the PLY file.
        positions: (K, 3) positions, as `coordinate_columns` takes them.
        colors: (K, 3) in [0, 1].
        normals: (K, 3) unit vectors, or None.

    Raises:
        OSError: if the file cannot be written.
    """
    columns = coordinate_columns(file, positions)
    if normals is not None:
        columns += zip(("nx", "ny", "nz"), normals.float().numpy().T, strict=True)
    stored = (colors.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    columns += zip(("red", "green", "blue"), stored.T, strict=True)
    write_columns(file, columns)


def coordinate_columns(file: Path, positions: Tensor) -> list[tuple[str, np.ndarray]]:
    """Return x, y, z of `positions` (K, 3) as float32, or float64 with a note on `file` if that is too coarse."""
    if local_origin(positions) is None:
        return list(zip("xyz", positions.float().numpy().T, strict=True))
    say(f"{file.name}: {in_full(positions)}")
    return list(zip("xyz", positions.double().numpy().T, strict=True))


def in_full(positions: Tensor) -> str:
    """Return a sentence on `positions` (K, 3) that are written in float64, since float32 is too coarse for them."""
    return (
        f"so far from the origin, float32 would round coordinates by up to {rounding(positions):.2g}; they are "
        "written in double precision, for programs that read it"
    )


def write_columns(
    file: Path, columns: Sequence[tuple[str, np.ndarray]], faces: Tensor | None = None, comments: Sequence[str] = ()
) -> None:
    """Write vertices to a binary PLY file, little endian, as a whole or not at all.

    Args:
        file: path of the PLY file.
        columns: names and values (K,) of the properties, uint8, float32 or float64.
        faces: (F, 3) int64 vertices of triangles; None if there are none.
        comments: lines for its header.

    Raises:
        OSError: if the file cannot be written.
    """
    kinds = [(name, NAMES[values.dtype.name]) for name, values in columns]
    table = np.empty(len(columns[0][1]), [(name, "<" + TYPES[kind]) for name, kind in kinds])
    for name, values in columns:
        table[name] = values
    triangles = np.empty(0 if faces is None else len(faces), [("count", "u1"), ("index", "<i4", 3)])
    if faces is not None:
        triangles["count"], triangles["index"] = 3, faces.numpy()
    header = header_text(len(table), kinds, None if faces is None else len(faces), comments)
    write_atomically(file, lambda stream: stream.writelines([header, table.data, triangles.data]))


def header_text(
    count: int, kinds: Sequence[tuple[str, str]], faces: int | None = None, comments: Sequence[str] = ()
) -> bytes:
    """Return the header of a binary file, little endian, of `count` vertices with properties of `kinds`.

    `faces` is the number of triangles behind them, None for no such element; `comments` are further lines.
    """
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    lines += [f"element vertex {count}"]
    lines += [f"property {kind} {name}" for name, kind in kinds]
    if faces is not None:
        lines += [f"element face {faces}", "property list uchar int vertex_indices"]
    return ("\n".join([*lines, "end_header"]) + "\n").encode()
