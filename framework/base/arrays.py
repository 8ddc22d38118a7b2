"""numpy's files of a single array (.npy), as far as they are as long as they say."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def read_array(path: Path) -> np.ndarray:
    """The array of a .npy file.

    No more memory is asked for than the file has bytes, whatever its header claims.

    Raises: OSError where it cannot be read; ValueError, and whatever else numpy raises, where it is no such file, is
        cut short, or would have to run code.
    """
    with path.open("rb") as file:
        start = file.read(12)
    # Version 1 counts its header's bytes by two bytes; later ones by four, and numpy makes room for as many.
    if start[6:7] > b"\1" and int.from_bytes(start[8:], "little") > path.stat().st_size:
        raise ValueError("it is shorter than its header")
    with np.errstate(over="ignore"):  # a claimed shape's product
        found = np.load(path, mmap_mode="r", allow_pickle=False)  # a mapping longer than the file is refused
    if not isinstance(found, np.ndarray):
        found.close()
        raise ValueError("it holds several arrays")
    return np.array(found)  # copied: whoever cuts a mapped file short kills the process that reads on
