"""Errors that a user can act on: one line with the fault, the place and the remedy."""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Iterable
from typing import Any

MAX_MESSAGE_LENGTH = 2000
"""Maximum number of characters of an error message. Text quoted from a damaged file may be longer than a screen."""
MAX_LISTED = 40
"""Maximum number of names that a hint lists."""


class NerfloomError(ValueError):
    """Base class of the errors that the command line prints as one line, without a traceback.

    Line breaks and control characters of `message` are escaped, and the end beyond `MAX_MESSAGE_LENGTH` is cut off.
    """

    def __init__(self, message: str) -> None:
        line = printable(message)
        super().__init__(line if len(line) <= MAX_MESSAGE_LENGTH else f"{line[:MAX_MESSAGE_LENGTH]}...")


class DataError(NerfloomError):
    """The data set cannot be used: input is missing, unreadable or contradictory."""


class ConfigError(NerfloomError):
    """A setting, a name or a configuration file is wrong."""


class FlagError(ConfigError):
    """A flag is unknown, missing or has an invalid value. The command exits with status 2."""


class CheckpointError(NerfloomError):
    """A checkpoint cannot be read, or does not fit the model."""


class DivergenceError(NerfloomError):
    """Training met non-finite values in too many consecutive steps."""


class LostProcessError(NerfloomError):
    """Another process of the same run has ended, or its model differs."""


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether `error` is an out-of-memory error of Python or PyTorch."""
    text = str(error)
    return isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError) and ("out of memory" in text or "allocate memory" in text)
    )


def one_line(error: BaseException) -> str:
    """Return the message of `error` on one line of at most 300 characters, or the name of its type if it has none."""
    return " ".join(str(error).split())[:300] or type(error).__name__


def nearest(name: str, candidates: Iterable[str]) -> str:
    """Return a hint that names the candidates closest to a misspelt name, or lists all of them if they are few.

    Args:
        name: the misspelt name.
        candidates: valid names.

    Returns:
        A sentence such as ``Did you mean 'instant-ngp'?``.
    """
    candidates = sorted(candidates)
    close = difflib.get_close_matches(name, candidates, n=3, cutoff=0.5)
    if close:
        return "Did you mean " + " or ".join(repr(match) for match in close) + "?"
    if len(candidates) > MAX_LISTED:
        return f"None of the {len(candidates):,} known names is similar."
    return "Known: " + ", ".join(candidates) + "."


def printable(text: str) -> str:
    """Return `text` with unprintable characters escaped, including line breaks."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


_BRIEF = reprlib.Repr()
_BRIEF.maxlevel = 3
_BRIEF.maxlist = _BRIEF.maxtuple = _BRIEF.maxdict = 10
_BRIEF.maxstring = _BRIEF.maxother = _BRIEF.maxlong = 60


def shown(value: Any) -> str:
    """Return a short `repr` of `value` for a message: one line of at most 60 characters, for any size or nesting."""
    if isinstance(value, int) and abs(value) >= 10**30:
        return "a huge integer"
    try:
        text = printable(_BRIEF.repr(value))
    except ValueError:  # Python refuses to write integers of thousands of digits
        text = f"a {type(value).__name__} that cannot be written"
    return text if len(text) <= 60 else f"{text[:57]}..."
