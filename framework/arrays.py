"""numpy's files of a single array (.npy), as far as they are as long as they say."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def read_array(path: Path) -> np.ndarray:
    """The array of a .npy file.

    Raises: OSError where it cannot be read; ValueError, and whatever else numpy raises, where it is no such file, holds
        less than its header claims, or would have to run code.
    """
    # Mapped first: that a header claims more than the file has is noticed before any memory is asked for.
    with np.errstate(over="ignore"):  # a claimed shape's product
        found = np.load(path, mmap_mode="r", allow_pickle=False)
    if not isinstance(found, np.ndarray):
        found.close()
        raise ValueError("it holds several arrays")
    return np.array(found)  # copied: whoever cuts a mapped file short kills the process that reads on
