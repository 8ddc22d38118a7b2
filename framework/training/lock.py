"""A run's folder belongs to one process at a time. The system keeps the lock, so it ends with its process, however."""

from __future__ import annotations

import errno
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from framework.base.errors import ConfigError

LOCK = ".lock"
"""The file that is locked; it says by whom, and means nothing when it is there unlocked."""


@contextmanager
def sole_user(folder: Path) -> Iterator[None]:
    """Hold a run's folder, which is made where it is missing.

    Where the system or the file system has no locks, nothing is held.

    Raises: ConfigError where another process holds the folder, or it cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # A link could lead to a file of someone's, which would be written over.
        opened = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o644)
    except OSError as error:
        raise ConfigError(f"cannot write the run's folder {folder}: {error.strerror or error}") from error
    try:
        if not os.access(folder, os.W_OK):  # where a lock of before may be written to nevertheless
            raise ConfigError(f"cannot write the run's folder {folder}: {os.strerror(errno.EACCES)}")
        if not _locked(opened):
            who = os.read(opened, 200).decode("utf-8", "replace") or "another process"
            raise ConfigError(f"{folder} is in use by {who}; wait until it has ended, or stop it")
        with suppress(OSError):  # a full disk: then nobody is told who it is
            os.ftruncate(opened, 0)
            os.write(opened, f"process {os.getpid()} on {platform.node()}".encode())
        yield
    finally:
        os.close(opened)


def _locked(opened: int) -> bool:
    """Lock an open file; False where another has."""
    try:
        import fcntl
    except ImportError:  # Windows
        return True
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True
