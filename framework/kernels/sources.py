"""Fingerprint of the C++ sources of a library of kernels.

setup.py writes it into each library, and native.py compares it with the fingerprint of the sources beside the library.
"""

from __future__ import annotations

import hashlib
from pathlib import Path


def fingerprint(folder: Path) -> int:
    """Return a number of 63 bits for the names and contents of the C++ files in the folders of a folder.

    Args:
        folder: the folder `kernels`, with a folder for each family.
    """
    digest = hashlib.sha256()
    paths = {path.relative_to(folder).as_posix(): path for path in (*folder.glob("*/*.cpp"), *folder.glob("*/*.h"))}
    for name, path in sorted(paths.items()):
        content = path.read_bytes()
        digest.update(f"{name} {len(content)}\n".encode())
        digest.update(content)
    return int.from_bytes(digest.digest()[:8], "big") >> 1
