"""The object of fuzzing: a reader of a folder of unchecked files."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Reader:
    """A reader, and its files."""

    build: Callable[[Path], object]
    """Writes a small valid input into an empty folder."""
    read: Callable[[Path, Path], object]
    """Reads the folder; may write below a second one. Raises a `NerfloomError` for bad input, and any other error is an
    escape; so is `Nonsense`, for input that was taken and makes no sense."""
    targets: tuple[str, ...]
    """Patterns of the files that are damaged."""
    words: tuple[str, ...] = ()
    """Names that entries of the files may have, to be added in the wrong place."""


class Nonsense(Exception):
    """Values were read that cannot be: they should have been refused."""


def require(holds: object, what: str) -> None:
    """Raises: Nonsense if a condition does not hold for the values read."""
    if not holds:
        raise Nonsense(what)
