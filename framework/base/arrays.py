"""Reading of .npy and .npz files that may be damaged."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
"""Version of the .npy format -> function that reads a header."""


def read_array(path: Path) -> np.ndarray:
    """Read the array of a .npy file.

    The memory allocated is at most the size of the file, for any shape in the header.

    Raises:
        OSError: if the file cannot be read.
        ValueError: if it is not a .npy file, is truncated, or holds pickled objects. numpy may raise other errors.
    """
    with path.open("rb") as file:
        start = file.read(12)
    # Version 1 stores the header's length in two bytes, later versions in four; numpy allocates that many bytes.
    if start[6:7] > b"\1" and int.from_bytes(start[8:], "little") > path.stat().st_size:
        raise ValueError("it is shorter than its header")
    with np.errstate(over="ignore"):  # the product of the claimed shape
        array = np.load(path, mmap_mode="r", allow_pickle=False)  # numpy refuses a mapping longer than the file
    if not isinstance(array, np.ndarray):
        array.close()
        raise ValueError("it holds several arrays")
    return np.array(array)  # a copy: if another process truncated a mapped file, reading it would kill this one


def read_small_arrays(path: Path, wanted: Callable[[str], bool], largest: int) -> dict[str, np.ndarray]:
    """Read arrays of numbers from a .npz file.

    Nothing is unpickled, no other entry is read, and an entry's header is compared with its size before memory is
    allocated.

    Args:
        wanted: whether to read the array of a name.
        largest: maximum size of an array's entry, bytes uncompressed.

    Returns:
        Name -> array.

    Raises:
        OSError: if the file cannot be read.
        zipfile.BadZipFile: if it is not a zip file.
        ValueError: if an array is damaged, too large or not of numbers. zipfile and numpy may raise other errors.
    """
    arrays = {}
    with zipfile.ZipFile(path) as archive:
        for entry in archive.infolist():
            name = entry.filename.removesuffix(".npy")
            if name == entry.filename or not wanted(name):
                continue
            with archive.open(entry) as file:
                content = file.read(largest + 1)
            if len(content) > largest:
                raise ValueError(f"{name} is larger than {largest} bytes")
            arrays[name] = _array_of(content, name)
    return arrays


def _array_of(content: bytes, name: str) -> np.ndarray:
    """Return the array of numbers in the bytes of a .npy file."""
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    if version not in HEADERS:
        raise ValueError(f"{name} has version {version} of the .npy format; 1.0 and 2.0 are known")
    shape, by_columns, dtype = HEADERS[version](stream)
    if dtype.kind not in "fiu":
        what = "pickled objects, which are not read" if dtype.hasobject else f"values of type {dtype}"
        raise ValueError(f"{name} holds {what}; it must hold numbers")
    count = math.prod(shape)
    if count < 0 or count * dtype.itemsize != len(content) - stream.tell():
        raise ValueError(f"{name} is truncated, or its header is damaged")
    values = np.frombuffer(content, dtype, count, stream.tell())
    return values.reshape(shape, order="F" if by_columns else "C")
