"""The C++ sources that a library of kernels was built from, as a number.

setup.py writes it into each library, and native.py compares it with that of the sources beside the library.
"""

from __future__ import annotations

import hashlib
from pathlib import Path


def fingerprint(folder: Path) -> int:
    """Return a number of 63 bits for the names and contents of the C++ files in a folder.

    Args:
        folder: the folder, of which only .cpp and .h files count.
    """
    digest = hashlib.sha256()
    for path in sorted((*folder.glob("*.cpp"), *folder.glob("*.h")), key=lambda path: path.name):
        content = path.read_bytes()
        digest.update(f"{path.name} {len(content)}\n".encode())
        digest.update(content)
    return int.from_bytes(digest.digest()[:8], "big") >> 1
