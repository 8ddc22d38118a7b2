"""The cache of decoded pixels: image sets that are larger than memory may hold are decoded once, into a file.

A file is the pixels (P, C) uint8, then a .npz with what else was found while decoding, its length, and `MAGIC`. It gets
its name only when it is whole. Its name is a hash of what it was made from, so it is never out of date; files of images
that have changed since are not removed.
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

from framework.base.archives import unfolded_size
from framework.base.device import machine_memory
from framework.base.errors import DataError
from framework.base.user_cache import cache_folder
from framework.data.pixel_store import FileStore

FORMAT = 1
"""Raised whenever the file, or what is decoded into it, changes."""
MAGIC = b"NERFLOOM"
MB = 1_000_000


@dataclass(frozen=True)
class PixelMemory:
    """How much of a split's pixels may be held in memory, and where they lie if they are more."""

    limit: float
    """Bytes."""
    folder: Path
    """Where cached pixels are kept."""

    @classmethod
    def of(cls, limit: float | None = None, folder: Path | None = None) -> PixelMemory:
        """From the settings: the limit in MB, half of the machine's memory if None; the user's cache folder if None."""
        return cls(machine_memory() / 2 if limit is None else limit * MB, folder or cache_folder())


def cache_path(folder: Path, files: list[Path | None], numbers: list[int]) -> Path:
    """The name of the pixels made from files: their absolute paths, sizes and times of change, and what else counts."""
    digest = hashlib.blake2b(repr((FORMAT, numbers)).encode(), digest_size=16)
    for file in files:
        about: tuple[object, ...] = (None,)
        if file is not None and file.is_file():
            stat = file.stat()
            about = (str(file.resolve()), stat.st_size, stat.st_mtime_ns)
        digest.update(repr(about).encode())
    return folder / f"pixels-{digest.hexdigest()}.bin"


def pack(facts: dict[str, np.ndarray]) -> bytes:
    """What stands behind the pixels."""
    content = io.BytesIO()
    np.savez(content, **facts)  # type: ignore[arg-type]
    values = content.getvalue()
    return values + len(values).to_bytes(8, "little") + MAGIC


def unpack(path: Path) -> dict[str, np.ndarray] | None:
    """What stands behind the pixels of a file; None where there is no such file, or it is not whole."""
    try:
        with path.open("rb") as file:
            size = file.seek(-16, os.SEEK_END)
            length, magic = int.from_bytes(file.read(8), "little"), file.read(8)
            if magic != MAGIC or length > size:
                return None
            file.seek(size - length)
            packed = file.read(length)
        if unfolded_size(io.BytesIO(packed)) > length:  # `pack` compresses nothing
            return None
        with np.load(io.BytesIO(packed), allow_pickle=False) as content:
            facts = {name: content[name] for name in content.files}
        whole = size - length == int(facts["pixels"]) * int(facts["channels"])
    except Exception:  # numpy, zipfile and zlib raise ValueError, EOFError, KeyError, BadZipFile, zlib.error and more
        return None
    return facts if whole else None


def temporary_store(path: Path, size: int) -> FileStore:
    """A file beside `path` to write `size` bytes to, once what killed processes left there is removed.

    Raises: DataError where there is no room.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for remnant in path.parent.glob(f".pixels-*.{_host()}.*.tmp"):
            if not _alive(remnant.name.split(".")[-2]):
                remnant.unlink(missing_ok=True)
        return FileStore(path.with_name(f".{path.stem}.{_host()}.{os.getpid()}.tmp"), size)
    except OSError as error:
        raise no_room(path.parent, size, error) from error


def no_room(folder: Path, size: int, error: OSError) -> DataError:
    """The error where `size` bytes could not be written."""
    try:
        free = f", where {shutil.disk_usage(folder).free / MB:,.0f} MB are free"
    except OSError:
        free = ""
    return DataError(
        f"cannot write decoded pixels: {size / MB:,.0f} MB are needed in {folder}{free} ({error.strerror}); "
        "make room, name another --cache-dir, or raise --cache-limit if memory has room for them"
    )


def _host() -> str:
    return "".join(letter for letter in platform.node() if letter.isalnum()) or "host"


def _alive(process: str) -> bool:
    """Whether this machine runs a process of that number; taken for granted where it cannot be asked harmlessly."""
    if os.name != "posix" or not process.isdecimal():
        return True
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True
