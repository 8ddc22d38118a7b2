"""Files that belong together although their names differ, such as 000012.png, its mask 012.png and camera 12."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from nerfloom.data.folders import walk
from nerfloom.data.names_on_disk import without_ending
from nerfloom.data.suffixes import IMAGE_SUFFIXES

LAST_NUMBER = re.compile(r"(\d{1,18})\D*$")
"""The last number in a name."""


def image_names(folder: Path) -> list[str]:
    """Return the sorted names of the images in `folder`; none if it is not a folder."""
    names = next(walk(folder), (folder, list[str]()))[1]
    return [name for name in names if name.lower().endswith(IMAGE_SUFFIXES) and (folder / name).is_file()]


def last_number(name: str) -> str | None:
    """Return the last number in `name`, without leading zeros; None if there is none. The extension is ignored."""
    found = LAST_NUMBER.search(without_ending(name))
    return None if found is None else str(int(found[1]))


def partners(names: Sequence[str], others: Sequence[str]) -> tuple[list[int | None], str]:
    """Return the partner of each of M names among N others, and the word for how they were matched.

    Names without their extensions are compared, then the last numbers in them. If neither finds a partner for every
    name and there are as many others as names, they may be matched by order: if their numbers differ by a constant,
    such as when one list starts at 0 and the other at 1, or if no name and no number agrees. Otherwise, names without a
    partner stay without one.

    Args:
        names: M names of images, in order.
        others: N names, in order.
    """
    best: tuple[list[int | None], str] = ([None] * len(names), "name")
    for key, words in KEYS:
        found = _matched([key(name) for name in names], [key(name) for name in others])
        if None not in found:
            return found, words
        if found.count(None) < best[0].count(None):
            best = found, words
    shifted = _shifted([last_number(name) for name in names], [last_number(other) for other in others])
    if shifted is not None:
        return shifted, "order"
    if len(names) == len(others) and best[0].count(None) == len(names):
        return list(range(len(names))), "order"
    return best


KEYS: tuple[tuple[Callable[[str], str | None], str], ...] = ((without_ending, "name"), (last_number, "number"))
"""The parts that two names may share, and the word for each."""


def _shifted(names: Sequence[str | None], others: Sequence[str | None]) -> list[int | None] | None:
    """Return for each number the index of the one at the same rank among others, if all differ by one constant."""
    ours = [int(number) for number in names if number is not None]
    theirs = [int(number) for number in others if number is not None]
    if not len(ours) == len(names) == len(theirs) == len(others) == len(set(ours)):
        return None
    shift = min(theirs) - min(ours)
    places = {number: index for index, number in enumerate(theirs)}
    found = [places.get(number + shift) for number in ours]
    return None if None in found else found


def _matched(names: Sequence[str | None], others: Sequence[str | None]) -> list[int | None]:
    """Return for each name the index of the same key among others; None for a key that is missing or not unique."""
    ours, theirs = Counter(names), Counter(others)
    places = {key: index for index, key in enumerate(others) if key is not None and theirs[key] == 1}
    return [places.get(key) if key is not None and ours[key] == 1 else None for key in names]
