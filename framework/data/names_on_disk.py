"""Matching of a data set's file names with the files on the disk, where spellings may differ.

A name is looked for as written, then with other separators, in another encoding, in another case, with another ending,
and, if no name is found at all, in another folder. A match counts only if it is unique both ways. Differences are
reported.
"""

from __future__ import annotations

import difflib
import os
import posixpath
import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path, PurePath
from urllib.parse import unquote

from nerfloom.base.console import say
from nerfloom.data.folders import walk
from nerfloom.data.suffixes import IMAGE_SUFFIXES

LIKELIEST = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG", ".webp")
"""Endings tried, in this order, for a name without one."""
REDUCED = (1, 2, 4, 8)
"""Factors of images reduced in advance; `images_2` holds images reduced by 2."""
MAX_FILES = 200_000
"""Maximum number of files below a folder that are searched."""
COMPANIONS = re.compile(
    r"(mask|depth|normal|semantic|segment(ation)?|label|confidence|thumb(nail)?)s?([ _-]?(map|image)s?)?(_\d+)?",
    re.IGNORECASE,
)
"""Names of folders with files that accompany images under the same names, such as masks_2."""
MAX_FOLDERS = 100
"""Maximum number of folders searched for one image."""
MAX_NAMED = 3
"""Maximum number of names suggested in a message."""


@dataclass(frozen=True)
class Matches:
    """Files matched with names."""

    files: dict[str, str]
    """Name as written -> path in the folder, with slashes; names without a match are missing."""
    notes: tuple[str, ...]
    """A sentence for each kind of difference between names and files, with their number and an example."""


def on_disk(
    folder: Path,
    names: Sequence[str],
    what: str = "images",
    endings: Sequence[str] = IMAGE_SUFFIXES,
    quiet: bool = False,
    shared: int = 1,
) -> tuple[Path, ...]:
    """Return the files that match names, and report names that are spelled differently on the disk.

    Args:
        folder: folder that the names are relative to.
        names: M names from a data set.
        what: kind of the files, as a plural, for messages.
        endings: endings of such files, in lower case.
        quiet: whether to report nothing.
        shared: minimum number of path parts, from the end, that a file in another folder has in common with a name. Use
            2 for files that accompany images, because these have the images' names and differ by folder.

    Returns:
        M paths; names without a match give paths as written. A file may exist only in a folder of reduced images; its
        path is then the one at full size.
    """
    found = match_names(folder, names, endings, shared)
    for note in () if quiet else found.notes:
        say(f"{folder}: {what}: {note}")
    return tuple(
        folder / found.files.get(name, name if PurePath(name).suffix else name + LIKELIEST[0]) for name in names
    )


def match_names(
    folder: Path, names: Sequence[str], endings: Sequence[str] = IMAGE_SUFFIXES, shared: int = 1
) -> Matches:
    """Return the files that match names and notes on the differences, without reporting them.

    Args:
        folder: folder that the names are relative to.
        names: M names from a data set.
        endings: endings of such files, in lower case.
        shared: as in `on_disk`.
    """
    files = {name: written for name in names if (written := _as_written(folder, name)) is not None}
    missing = sorted(set(names) - set(files))
    notes: list[str] = []
    below = files_below(folder, endings) if missing else []
    for words, key in SPELLINGS:
        taken = {_tidy(file) for file in files.values()}
        pairs = _paired(missing, [file for file in below if file not in taken], key)
        if pairs and words:
            notes.append(_note(pairs, len(names), words))
        files |= pairs
        missing = [name for name in missing if name not in pairs]
    if missing and not files:
        for key in (spelled, without_ending):
            if files := _moved(missing, below, key, shared):
                notes.append(_note(files, len(names), "in another folder"))
                break
    return Matches(files, tuple(notes))


def spelled(name: str) -> str:
    """Return the normal form of `name` for comparisons: slashes, no percent-encoding, composed (NFC), lower case."""
    return _decoded(name).casefold()


def files_below(folder: Path, endings: Sequence[str] = IMAGE_SUFFIXES) -> list[str]:
    """Return the sorted paths of files below a folder, with slashes; none if there are too many. Never raises.

    A file in a folder of reduced images, such as images_2, also counts as a file in `images`.

    Args:
        folder: the folder; hidden files are skipped.
        endings: endings of the files, in lower case.
    """
    found: set[str] = set()
    for place, names in walk(folder):
        inside = place.relative_to(folder)
        suited = [name for name in names if name.lower().endswith(tuple(endings))]
        found |= {(inside / name).as_posix() for name in suited}
        if inside.parts and (base := _full_size(inside.parts[0])):
            found |= {Path(base, *inside.parts[1:], name).as_posix() for name in suited}
        if len(found) > MAX_FILES:
            return []
    return sorted(found)


def reduced_folder(folder: Path, factor: int) -> Path:
    """Return the folder of images reduced by a `factor`: beside the `folder` of the originals, such as images_2."""
    return folder if factor == 1 else folder.with_name(f"{folder.name}_{factor}")


def files_in(folders: Iterable[Path]) -> dict[Path, dict[str, str]]:
    """Return the names of the files in each of `folders` by their lower-case form. Never raises.

    Reading a folder once is much faster than asking for each of many files.
    """
    return {folder: {name.lower(): name for name in _names_in(folder)} for folder in set(folders)}


def are_files(paths: Sequence[Path]) -> list[bool]:
    """Return for each of `paths` whether it is a file."""
    listed = {folder: set(_names_in(folder)) for folder in {path.parent for path in paths}}
    # A name in another case is the same file for some systems.
    return [path.name in listed[path.parent] or path.is_file() for path in paths]


def _names_in(folder: Path) -> list[str]:
    try:
        with os.scandir(folder) as entries:
            return sorted(entry.name for entry in entries if entry.is_file())
    except OSError:
        return []


def accompanies(folders: Iterable[str]) -> bool:
    """Return whether a file in these nested `folders` accompanies an image, as a mask does, by one of their names."""
    return any(COMPANIONS.fullmatch(folder) for folder in folders)


def distinct_names(paths: Sequence[Path]) -> tuple[str, ...]:
    """Return the ends of `paths` with the fewest parts that distinguish all files, such as left/1.jpg and right/1.jpg.

    Cameras of a rig often have images of the same names in folders of their own.
    """
    names: tuple[str, ...] = ()
    for count in range(1, max((len(path.parts) for path in paths), default=0) + 1):
        names = tuple("/".join(path.parts[-count:]) for path in paths)
        if len(set(names)) == len(set(paths)):
            break
    return names


def has_images(folder: Path) -> bool:
    """Return whether a quick look finds an image in or below `folder`. Never raises."""
    return any(_is_image(name) for _, names in islice(walk(folder), MAX_FOLDERS) for name in names)


def nearest_on_disk(path: Path) -> str:
    """Return words for an error message about a `path` that does not exist: similar names that do, or a broken link."""
    parent = path.parent
    while not parent.is_dir() and parent != parent.parent:
        path, parent = parent, parent.parent
    if path.is_symlink():  # its content was moved, or never fetched
        return f"{path} is a link to {os.readlink(path)}, which does not exist"
    try:
        there = sorted(islice((entry.name for entry in os.scandir(parent) if entry.name[0] != "."), MAX_FILES))
    except OSError:
        there = []
    if not there:
        return f"{parent} is empty"
    lower = {name.casefold(): name for name in there}
    near = difflib.get_close_matches(path.name.casefold(), lower, MAX_NAMED, 0.5) or list(lower)[:MAX_NAMED]
    return f"{parent} has no {path.name}, but {', '.join(lower[name] for name in near)}"


def _as_written(folder: Path, name: str) -> str | None:
    """Return the name if the file exists, otherwise the name with the first likely ending that a file has."""
    if (folder / name).is_file():
        return name
    if _is_image(name):
        return None
    return next((name + ending for ending in LIKELIEST if (folder / (name + ending)).is_file()), None)


def _is_image(name: str) -> bool:
    return name.lower().endswith(IMAGE_SUFFIXES)


def _full_size(name: str) -> str:
    """Return the name of a folder of reduced images without its factor; '' if it has none."""
    base, _, factor = name.rpartition("_")
    return base if factor in map(str, REDUCED[1:]) else ""


def _tidy(name: str) -> str:
    return posixpath.normpath(name.strip().replace("\\", "/"))


def _decoded(name: str) -> str:
    return unicodedata.normalize("NFC", unquote(_tidy(name)))


def without_ending(name: str) -> str:
    """Return `name` as `spelled` does, without the ending of an image."""
    path = spelled(name)
    stem, dot, ending = path.rpartition(".")
    return stem if dot + ending in IMAGE_SUFFIXES else path


def companions_of(names: Sequence[str], files: Iterable[str]) -> tuple[str | None, ...]:
    """Return the file that accompanies each name: of its spelling (`spelled`), with an additional or another ending.

    Args:
        names: M names of images.
        files: names of the files, relative to a folder that corresponds to that of the images.

    Returns:
        M of the `files`; None for a name without one.
    """
    found = {key: file for file in files for key in (without_ending(file), spelled(file))}
    return tuple(found.get(spelled(name), found.get(without_ending(name))) for name in names)


SPELLINGS: tuple[tuple[str, Callable[[str], str]], ...] = (
    ("", str),
    ("with other separators", _tidy),
    ("in another encoding", _decoded),
    ("in another case", spelled),
    ("with another ending", without_ending),
)
"""Kinds of differences between a name and the disk, strictest first: words for messages, and the compared form."""


def _paired(names: Iterable[str], files: Iterable[str], key: Callable[[str], str]) -> dict[str, str]:
    """Return name -> file for keys that exactly one name and one file have."""
    groups: defaultdict[str, tuple[list[str], list[str]]] = defaultdict(lambda: ([], []))
    for name in names:
        groups[key(name)][0].append(name)
    for file in files:
        groups[key(file)][1].append(file)
    return {ours[0]: theirs[0] for ours, theirs in groups.values() if len(ours) == len(theirs) == 1}


def _moved(names: Sequence[str], files: Sequence[str], key: Callable[[str], str], least: int) -> dict[str, str]:
    """Return name -> file if replacing one beginning of paths by another finds more than half of the names.

    The beginnings that leave the longest common end for the most names are used. Among several, the folder called
    images is preferred; without one, nothing is found. Ends of fewer than `least` parts do not count, nor do folders of
    files that accompany images, such as masks.
    """
    keys = Counter(map(key, files))
    by_key = {known: file for file in files if keys[known := key(file)] == 1}
    ends: defaultdict[str, list[list[str]]] = defaultdict(list)
    for known in by_key:
        ends[posixpath.basename(known)].append(known.split("/"))
    votes: Counter[tuple[str, str]] = Counter()
    for name in names:
        parts = key(name).split("/")
        shared = [(_common_end(parts, there), there) for there in ends[parts[-1]]]
        longest = max((length for length, _ in shared), default=0)
        if longest < least:
            continue
        votes.update(
            ("/".join(parts[:-length]), "/".join(there[:-length]))
            for length, there in shared
            if length == longest and not accompanies(there[:-length])
        )
    most = max(votes.values(), default=0)
    best = sorted((-there.split("/").count("images"), cut, there) for (cut, there), n in votes.items() if n == most)
    if 2 * most <= len(names) or (len(best) > 1 and best[0][0] == best[1][0]):
        return {}
    _, cut, there = best[0]
    changed = {
        name: posixpath.join(there, key(name)[len(cut) :].lstrip("/")) for name in names if key(name).startswith(cut)
    }
    return {name: by_key[moved] for name, moved in changed.items() if moved in by_key}


def _common_end(a: Sequence[str], b: Sequence[str]) -> int:
    """Return the number of parts that two paths have in common at the end."""
    return next(
        (n for n, (x, y) in enumerate(zip(reversed(a), reversed(b), strict=False)) if x != y), min(len(a), len(b))
    )


def _note(pairs: dict[str, str], total: int, words: str) -> str:
    name, file = next(iter(pairs.items()))
    return f"{len(pairs)} of {total} found {words}: {name} as {file}"
