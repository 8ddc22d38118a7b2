"""Installation of a public data set: download and unpack archives, and move scenes to where ns-train finds them."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import urlsplit

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, DataError, nearest
from nerfloom.downloads.catalogue import Archive, Dataset, Source
from nerfloom.downloads.fetch import SourceError, fetch
from nerfloom.downloads.unpack import Place, names_of, unpack
from nerfloom.training.data_folder import find_data
from nerfloom.training.lock import sole_user

UNFINISHED = ".downloads"
"""Folder beside the data sets for archives and for incomplete scenes."""
IGNORED = ("__MACOSX", ".DS_Store")
"""Names that macOS adds to zip files."""
NOTES = ("readme", "license", "licence")
"""Beginnings of names of files about all scenes, which are placed beside the scenes."""


def install(
    name: str,
    dataset: Dataset,
    save_dir: Path,
    scenes: Sequence[str] = (),
    archive: Path | None = None,
    keep_archives: bool = False,
) -> list[Path]:
    """Download the missing scenes of a data set.

    Args:
        name: name of the data set, and of its folder.
        dataset: the data set.
        save_dir: folder of the data sets, created if missing.
        scenes: names of the scenes; all if empty.
        archive: an archive downloaded by hand; None to download missing files.
        keep_archives: whether to keep archives after unpacking.

    Returns:
        The scenes' folders, `save_dir / name / scene`; a data format recognises each of them.

    Raises:
        ConfigError: if the data set has no such scene, or the folder cannot be written.
        DataError: if an archive is unavailable, unsafe or lacks the scenes. Complete scenes are kept.
    """
    chosen = _chosen(name, dataset, scenes)
    folder, unfinished = save_dir / name, save_dir / UNFINISHED
    _make_writable(unfinished)
    with sole_user(unfinished):
        for wanted in _archives(dataset, archive):
            missing = [scene for scene in wanted.scenes if scene in chosen and not (folder / scene).exists()]
            if not missing:
                continue
            file = archive or unfinished / wanted.name
            if archive is None and not file.exists():
                _fetch_from_any(wanted, dataset, file)
            _put_in_place(wanted, file, missing, folder, unfinished / f"{wanted.name}.unpacked")
            if archive is None and not keep_archives:
                file.unlink()
    absent = [scene for scene in chosen if not (folder / scene).exists()]
    if absent:
        raise DataError(f"{archive} lacks {', '.join(absent)}; select scenes that it contains with --scenes")
    return [folder / scene for scene in chosen]


def announce(name: str, dataset: Dataset, save_dir: Path, scenes: Sequence[str] = ()) -> None:
    """Report the download: licence, size, address, and whether the address was ever tried.

    Args:
        name: name of the data set.
        dataset: the data set.
        save_dir: folder of the data sets.
        scenes: names of the scenes; all if empty.

    Raises:
        ConfigError: if the data set has no such scene.
    """
    chosen = _chosen(name, dataset, scenes)
    say(f"{dataset.title}: {dataset.page}")
    say(f"licence: {dataset.licence}")
    for archive in dataset.archives:
        missing = [scene for scene in archive.scenes if scene in chosen and not (save_dir / name / scene).exists()]
        if missing:
            hosts = ", otherwise ".join(f"{_host(source)} ({_tried(source)})" for source in archive.sources)
            say(f"to download: {archive.name}, {size_of(archive)}, from {hosts}, for {', '.join(missing)}")


def size_of(archive: Archive) -> str:
    """Return the size of an `archive` in words."""
    return "of unknown size" if archive.gigabytes is None else f"about {archive.gigabytes:g} GB"


def _host(source: Source) -> str:
    return urlsplit(source.url).hostname or source.url


def _tried(source: Source) -> str:
    return f"tried on {source.tried}" if source.tried else "an address that nerfloom's authors have not tried"


def _chosen(name: str, dataset: Dataset, scenes: Sequence[str]) -> list[str]:
    for scene in scenes:
        if scene not in dataset.scenes:
            raise ConfigError(f"--scenes: {name} has no scene '{scene}'. {nearest(scene, dataset.scenes)}")
    return list(dict.fromkeys(scenes)) or list(dataset.scenes)


def _make_writable(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"cannot write {folder.parent}: {error.strerror}; use another --save-dir") from error
    if not os.access(folder, os.W_OK):
        raise ConfigError(f"cannot write {folder}; use another --save-dir")


def _archives(dataset: Dataset, given: Path | None) -> tuple[Archive, ...]:
    """Return the archives of a data set; for a given file only the archive with its name, or all if there is none."""
    if given is None:
        return dataset.archives
    if not given.is_file():
        raise ConfigError(f"--archive {given}: there is no such file")
    return tuple(archive for archive in dataset.archives if archive.name == given.name) or dataset.archives


def _fetch_from_any(archive: Archive, dataset: Dataset, file: Path) -> None:
    """Download an archive from the first source that has it."""
    problems = []
    for source in archive.sources:
        try:
            fetch(source, file)
            return
        except SourceError as error:
            problems.append(str(error))
            if source is not archive.sources[-1]:
                say(f"warning: {error}; trying the next source")
    by_hand = f"download {archive.name} in a browser, see {dataset.page}, and pass it with --archive FILE"
    raise DataError(f"{'; '.join(problems)}. If this persists: {by_hand}")


def _put_in_place(archive: Archive, file: Path, scenes: list[str], folder: Path, unpacked: Path) -> None:
    """Unpack some scenes of an archive, check that each is recognised, and rename them into `folder`."""
    shutil.rmtree(unpacked, ignore_errors=True)  # left by a killed process
    try:
        place = _placement(archive, scenes, names_of(file))
        unpack(file, unpacked, place)
        for scene in scenes:
            if not (unpacked / scene).is_dir():
                continue
            try:
                find_data(unpacked / scene)
            except DataError as error:
                raise DataError(f"{file}: the format of {scene} is unknown; the archive has changed") from error
        folder.mkdir(parents=True, exist_ok=True)
        for path in sorted(unpacked.iterdir()):
            if not (folder / path.name).exists():
                os.replace(path, folder / path.name)
    finally:
        shutil.rmtree(unpacked, ignore_errors=True)


def _placement(archive: Archive, scenes: Sequence[str], names: Sequence[tuple[str, ...]]) -> Place:
    """Return the target of each file of an archive: files below a scene's folder go into a folder named like the scene.

    Args:
        scenes: the scenes to unpack.
        names: paths of all its files, split into parts.
    """
    only = archive.scenes[0] if len(archive.scenes) == 1 else None
    # The folder of a single scene may have another name, or none.
    renamed = only is not None and not any(only in parts[:-1] for parts in names)
    kept = [parts for parts in names if not _is_ignored(parts)]
    top = 1 if renamed and len({parts[0] for parts in kept}) == 1 and all(len(parts) > 1 for parts in kept) else 0

    def place(parts: tuple[str, ...]) -> tuple[str, ...] | None:
        if _is_ignored(parts):
            return None
        if renamed and only is not None:
            return (only, *parts[top:]) if only in scenes else None
        for index, part in enumerate(parts[:-1]):
            if part in archive.scenes:  # the outermost match: a scene may contain a folder named like another scene
                return parts[index:] if part in scenes else None
        is_note = len(parts) <= 2 and parts[-1].lower().startswith(NOTES)
        return parts[-1:] if is_note else None

    return place


def _is_ignored(parts: tuple[str, ...]) -> bool:
    return any(part in IGNORED or part.startswith("._") for part in parts)
