"""What is fuzzed: something that reads a folder of files that nobody has checked."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Reader:
    """A reader, and what it reads."""

    build: Callable[[Path], object]
    """Writes a small valid input into an empty folder."""
    read: Callable[[Path, Path], object]
    """Reads the folder; may write below a second one. Raises a `NerfloomError` for bad input, and whatever else it
    raises is an escape; so is `Nonsense`, for input that was taken and makes no sense."""
    targets: tuple[str, ...]
    """Patterns of the files that are damaged."""
    words: tuple[str, ...] = ()
    """Names that entries of the files may have, to be added in the wrong place."""


class Nonsense(Exception):
    """What was read cannot be: it should have been refused."""


def require(holds: object, what: str) -> None:
    """Raises: Nonsense where something does not hold of what was read."""
    if not holds:
        raise Nonsense(what)
