"""Detection of photographs with names that show that they were taken one after the other."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import PurePath

MAX_STEP = 10
"""Maximum difference between the numbers of neighbours, since a few photographs may have been deleted."""
MIN_CONSECUTIVE = 0.8
"""Minimum fraction of neighbours with consecutive numbers."""
_NUMBER = re.compile(r"\d+")
_TIME = re.compile(r"(19|20)\d{6}[_-]?\d{6}")
"""Date and time in the names of phones' photographs."""


def is_sequence(names: Sequence[PurePath]) -> bool:
    """Return whether file `names`, in natural order, are numbered or dated consecutively."""
    follows = [_follows(first, second) for first, second in pairwise(names)]
    return bool(follows) and sum(follows) >= MIN_CONSECUTIVE * len(follows)


def _follows(first: PurePath, second: PurePath) -> bool:
    if _TIME.search(first.stem) and _TIME.search(second.stem):
        return True
    one, two = _numbered(first), _numbered(second)
    return one is not None and two is not None and one[0] == two[0] and 0 < two[1] - one[1] <= MAX_STEP


def _numbered(path: PurePath) -> tuple[str, int] | None:
    """Return the path without its last number, and that number; None if it has more than nine digits."""
    found = list(_NUMBER.finditer(path.stem))
    if not found or len(found[-1][0]) > 9:
        return None
    start, end = found[-1].span()
    return f"{path.parent.as_posix()}/{path.stem[:start]}#{path.stem[end:]}", int(found[-1][0])
