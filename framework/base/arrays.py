"""Reading of .npy files that may be damaged."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def read_array(path: Path) -> np.ndarray:
    """Read the array of a .npy file.

    The memory allocated is at most the size of the file, whatever shape the header claims.

    Args:
        path: the file.

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
