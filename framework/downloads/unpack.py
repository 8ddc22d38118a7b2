"""Safe unpacking of zip files: nothing outside the folder, no links, and limited sizes."""

from __future__ import annotations

import re
import shutil
import stat
import zipfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

from nerfloom.base.console import track_bytes
from nerfloom.base.errors import DataError, shown

MAX_FILES = 200_000
"""Maximum number of entries of an archive. The largest in the catalogue has about ten thousand."""
MAX_EXPANSION = 20
"""Maximum number of unpacked bytes per byte of an archive. Images are compressed already; text may be a tenth."""
MIN_ALLOWANCE = 1 << 20
"""Minimum unpacked size that is allowed for any archive, bytes."""
CHUNK = 1 << 20
"""Number of bytes written at a time."""
UNSAFE = re.compile(r'[\x00-\x1f\x7f<>:"|?*\\]|[. ]$')
"""Characters that a name must not have, because some systems interpret them: separators, drives, streams, wildcards."""
MAX_NAME = 255
"""Maximum length of a file's or folder's name, bytes."""

Place = Callable[[tuple[str, ...]], tuple[str, ...] | None]
"""Function from the parts of an entry's path to the parts of the path to write; None to skip the entry."""


def names_of(archive: Path) -> list[tuple[str, ...]]:
    """Return the paths of all files in the zip file `archive`, split into parts.

    Raises:
        DataError: if it is damaged, has too many entries, or an entry's path is unsafe.
    """
    with _opened(archive) as opened:
        return [_parts(entry, archive) for entry in _files(opened, archive)]


def unpack(archive: Path, folder: Path, place: Place) -> int:
    """Unpack a zip file, or a part of it.

    Everything in the archive's directory is checked before the first file is written.

    Args:
        archive: the zip file.
        folder: new folder to write into.
        place: function that gives each entry's target in the folder.

    Returns:
        Number of files written.

    Raises:
        DataError: if the archive is damaged, its content is unsafe or too large, or the disk is full.
    """
    with _opened(archive) as opened:
        entries = _files(opened, archive)
        _check_sizes(entries, archive)
        targets = [(entry, place(_parts(entry, archive))) for entry in entries]
        chosen = [(entry, target) for entry, target in targets if target]
        _check_targets([target for _, target in chosen], archive)
        total = sum(entry.file_size for entry, _ in chosen)
        folder.mkdir(parents=True)
        if total > (free := shutil.disk_usage(folder).free):
            needed = f"{archive.name} needs {total / 1e9:.1f} GB unpacked, {free / 1e9:.1f} GB are free"
            raise DataError(f"{folder.parent}: the disk is too small: {needed}; make room or use another folder")
        with track_bytes(f"unpacking {archive.name}", total) as advance:
            for entry, target in chosen:
                _write(opened, entry, folder.joinpath(*target), archive, advance)
    return len(chosen)


def _opened(archive: Path) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(archive)
    except OSError as error:
        raise DataError(f"cannot read {archive}: {error.strerror or error}") from error
    except (zipfile.BadZipFile, NotImplementedError, ValueError) as error:
        raise DataError(f"{archive} is damaged or not a zip file: {error}") from error


def _files(opened: zipfile.ZipFile, archive: Path) -> list[zipfile.ZipInfo]:
    """Return the entries that are files, after checking that all others are folders."""
    entries = opened.infolist()
    if len(entries) > MAX_FILES:
        raise DataError(f"{archive} has {len(entries)} entries; the limit is {MAX_FILES}")
    for entry in entries:
        kind = stat.S_IFMT(entry.external_attr >> 16)
        if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
            raise DataError(f"{archive}: {shown(entry.filename)} is a link or a device; nothing was unpacked")
        if entry.flag_bits & 1:
            raise DataError(f"{archive}: {shown(entry.filename)} is encrypted; nothing was unpacked")
    return [entry for entry in entries if not entry.filename.endswith("/")]


def _parts(entry: zipfile.ZipInfo, archive: Path) -> tuple[str, ...]:
    """Return the parts of an entry's path; `orig_filename` is the name as stored, before Python repairs it."""
    parts = tuple(entry.orig_filename.split("/"))
    for part in parts:
        if part in ("", ".", "..") or UNSAFE.search(part) or len(part.encode("utf-8", "replace")) > MAX_NAME:
            raise DataError(f"{archive}: the path {shown(entry.orig_filename)} is unsafe; nothing was unpacked")
    return parts


def _check_sizes(entries: Sequence[zipfile.ZipInfo], archive: Path) -> None:
    size = archive.stat().st_size
    if sum(entry.compress_size for entry in entries) > size:
        raise DataError(f"{archive}: its entries overlap, which is unsafe; nothing was unpacked")
    total = sum(entry.file_size for entry in entries)
    if total > MAX_EXPANSION * size + MIN_ALLOWANCE:
        raise DataError(f"{archive} of {size} bytes would unpack to {total}; nothing was unpacked")


def _check_targets(targets: Sequence[tuple[str, ...]], archive: Path) -> None:
    """Check that no two files have the same path, ignoring case, and that no file is also a folder."""
    folded = ["/".join(target).casefold() for target in targets]
    files = set(folded)
    folders = {name.rpartition("/")[0] for name in folded}
    while parents := {name.rpartition("/")[0] for name in folders} - folders:
        folders |= parents
    if len(files) < len(folded) or files & folders:
        raise DataError(f"{archive} has several entries for the same path; nothing was unpacked")


def _write(
    opened: zipfile.ZipFile, entry: zipfile.ZipInfo, path: Path, archive: Path, advance: Callable[[int], None]
) -> None:
    """Write one entry. Reading stops at the size stated in the directory, and the checksum is compared at the end."""
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with opened.open(entry) as content, path.open("xb") as file:
            while chunk := content.read(CHUNK):
                file.write(chunk)
                advance(len(chunk))
    except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, RuntimeError) as error:
        raise DataError(f"{archive}: {shown(entry.filename)} is damaged: {error}; download it again") from error
    except OSError as error:
        raise DataError(f"cannot write {path}: {error.strerror or error}; the archive {archive} is kept") from error
    if path.stat().st_size != entry.file_size:
        raise DataError(f"{archive}: {shown(entry.filename)} is shorter than stated; download it again")
