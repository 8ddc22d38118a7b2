"""Locks on open files, which the system releases when the last process with the file has ended."""

from __future__ import annotations


def locked(file: int) -> bool:
    """Lock an open file; return False if another process has locked it.

    Child processes that inherit the open file hold the lock too. On systems and file systems without locks, the result
    is True, without effect.

    Args:
        file: descriptor of the file.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True
