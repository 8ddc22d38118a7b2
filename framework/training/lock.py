"""The lock of a run's folder. One process holds it at a time; the system releases it when the process ends."""

from __future__ import annotations

import errno
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from nerfloom.base.errors import ConfigError
from nerfloom.base.file_lock import locked

LOCK = ".lock"
"""Name of the lock file. It names the process that holds the lock; its content is meaningless when unlocked."""


@contextmanager
def sole_user(folder: Path) -> Iterator[None]:
    """Lock a run's folder for this process, within a `with` block.

    No effect on systems and file systems without locks.

    Args:
        folder: the run's folder, created if missing.

    Raises:
        ConfigError: if another process has locked the folder, or it cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # A symbolic link could point to another file, which this would overwrite.
        opened = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
    except OSError as error:
        raise ConfigError(f"cannot write the run's folder {folder}: {error.strerror or error}") from error
    try:
        if not os.access(folder, os.W_OK):  # an old lock file may be writable in a read-only folder
            raise ConfigError(f"cannot write the run's folder {folder}: {os.strerror(errno.EACCES)}")
        if not locked(opened):
            owner = os.read(opened, 200).decode("utf-8", "replace") or "another process"
            raise ConfigError(f"{folder} is in use by {owner}; wait until it has ended, or stop it")
        with suppress(OSError):  # on a full disk, the owner stays unnamed
            os.ftruncate(opened, 0)
            os.write(opened, f"process {os.getpid()} on {platform.node()}".encode())
        yield
    finally:
        os.close(opened)
