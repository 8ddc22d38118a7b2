"""Files in and below a folder."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

NOT_THE_USERS = {"@eadir", "@recycle", "#recycle", "$recycle.bin", "__macosx", "thumbs.db", "desktop.ini"}
"""Lower-case names of folders and files that servers and systems add: thumbnails, deleted files, icons."""


def walk(folder: Path) -> Iterator[tuple[Path, list[str]]]:
    """Yield `folder` and the folders below it, each with the sorted names of its files. Never raises.

    Links to folders are followed, since many data sets are linked and not copied. No folder is entered twice, so a
    circle of links ends. Hidden files and folders, and those of `NOT_THE_USERS`, are skipped.
    """
    entered: set[str] = set()
    for place, folders, names in os.walk(folder, followlinks=True):
        real = os.path.realpath(place)
        if real in entered:
            folders.clear()
            continue
        entered.add(real)
        folders[:] = _of_the_user(folders)
        yield Path(place), _of_the_user(names)


def _of_the_user(names: list[str]) -> list[str]:
    return sorted(name for name in names if not name.startswith(".") and name.lower() not in NOT_THE_USERS)
