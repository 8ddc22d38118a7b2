"""Git LFS pointers: the small text files that stand in place of large ones until `git lfs pull` fetches these."""

from __future__ import annotations

from pathlib import Path

START = b"version https://git-lfs.github.com/spec/"
ADVICE = "it is a Git LFS pointer; run git lfs pull in its repository"


def is_pointer(file: Path) -> bool:
    """Return whether `file` is a Git LFS pointer. Never raises."""
    try:
        with file.open("rb") as stream:
            return stream.read(len(START)) == START
    except (OSError, ValueError):
        return False
