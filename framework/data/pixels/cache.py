"""Cache of decoded pixels: data sets that exceed the memory limit are decoded once, into a file.

A file holds the pixels (P, C) uint8, then an uncompressed .npz with the other results of decoding, its length, and
`MAGIC`. It is renamed to its final name when complete. The name is a hash of everything that the pixels depend on, so a
file is never out of date. Files for images that have changed since are not removed.
"""

from __future__ import annotations

import hashlib
import io
import os
import platform
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerfloom.base.archives import uncompressed_size
from nerfloom.base.device import machine_memory
from nerfloom.base.errors import DataError
from nerfloom.base.user_cache import cache_folder
from nerfloom.data.pixels.store import FileStore

FORMAT = 1
"""Version of the format; increase it whenever the file's layout or the decoded values change."""
MAGIC = b"NERFLOOM"
"""Last bytes of a complete file."""
MB = 1_000_000
"""Bytes of a megabyte."""


@dataclass(frozen=True)
class PixelMemory:
    """The memory limit for a split's pixels, and the folder for pixels that exceed it."""

    limit: float
    """Limit, bytes."""
    folder: Path
    """Folder of cached pixels."""

    @classmethod
    def of(cls, limit: float | None = None, folder: Path | None = None) -> PixelMemory:
        """Construct from a `limit` in MB, or half of the memory, and a `folder`, or the user's cache folder."""
        return cls(machine_memory() / 2 if limit is None else limit * MB, folder or cache_folder())


def cache_path(folder: Path, files: list[Path | None], numbers: list[int]) -> Path:
    """Return the path in `folder` of pixels that depend on `files` (path, size, modification) and `numbers`."""
    digest = hashlib.blake2b(repr((FORMAT, numbers)).encode(), digest_size=16)
    for file in files:
        identity: tuple[object, ...] = (None,)
        if file is not None and file.is_file():
            stat = file.stat()
            identity = (str(file.resolve()), stat.st_size, stat.st_mtime_ns)
        digest.update(repr(identity).encode())
    return folder / f"pixels-{digest.hexdigest()}.bin"


def pack(facts: dict[str, np.ndarray]) -> bytes:
    """Return the bytes after the pixels in a file: the arrays `facts`, their length and `MAGIC`."""
    content = io.BytesIO()
    np.savez(content, **facts)  # type: ignore[arg-type]
    values = content.getvalue()
    return values + len(values).to_bytes(8, "little") + MAGIC


def unpack(path: Path) -> dict[str, np.ndarray] | None:
    """Read the arrays after the pixels in the file `path`; None if it does not exist or is incomplete."""
    try:
        with path.open("rb") as file:
            size = file.seek(-16, os.SEEK_END)
            length, magic = int.from_bytes(file.read(8), "little"), file.read(8)
            if magic != MAGIC or length > size:
                return None
            file.seek(size - length)
            packed = file.read(length)
        if uncompressed_size(io.BytesIO(packed)) > length:  # `pack` does not compress
            return None
        with np.load(io.BytesIO(packed), allow_pickle=False) as content:
            facts = {name: content[name] for name in content.files}
        complete = size - length == int(facts["pixels"]) * int(facts["channels"])
    except Exception:  # numpy, zipfile and zlib raise ValueError, EOFError, KeyError, BadZipFile, zlib.error and more
        return None
    return facts if complete else None


def temporary_store(path: Path, size: int) -> FileStore:
    """Create a file of `size` bytes beside its final `path`, after removing leftovers of killed processes.

    Raises:
        DataError: if the disk lacks space.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for leftover in path.parent.glob(f".pixels-*.{_host()}.*.tmp"):
            if not _alive(leftover.name.split(".")[-2]):
                leftover.unlink(missing_ok=True)
        return FileStore(path.with_name(f".{path.stem}.{_host()}.{os.getpid()}.tmp"), size)
    except OSError as error:
        raise no_room(path.parent, size, error) from error


def no_room(folder: Path, size: int, error: OSError) -> DataError:
    """Return the error for a failed write of `size` bytes to the cache `folder`, by the system's `error`."""
    try:
        free = f", where {shutil.disk_usage(folder).free / MB:,.0f} MB are free"
    except OSError:
        free = ""
    return DataError(
        f"cannot write decoded pixels: {size / MB:,.0f} MB are needed in {folder}{free} ({error.strerror}); "
        "free some space, choose another --cache-dir, or raise --cache-limit if memory suffices"
    )


def _host() -> str:
    return "".join(letter for letter in platform.node() if letter.isalnum()) or "host"


def _alive(process: str) -> bool:
    """Return whether a process with this number runs; True on systems where the test could harm it."""
    if os.name != "posix" or not process.isdecimal():
        return True
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
