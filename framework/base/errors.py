"""Errors a user can act on: one line that says what, where and what to do."""

from __future__ import annotations

import difflib
import reprlib
from collections.abc import Iterable
from typing import Any

LONGEST_MESSAGE = 2000
"""Characters of an error; what a damaged file holds may be longer than a screen."""


class NerfloomError(ValueError):
    """Base of every error that the command line prints as one line, without a traceback.

    It is one line by construction, whatever the names and values out of files are that it speaks of.
    """

    def __init__(self, message: str) -> None:
        line = printable(message)
        super().__init__(line if len(line) <= LONGEST_MESSAGE else f"{line[:LONGEST_MESSAGE]}...")


class DataError(NerfloomError):
    """The data set cannot be used as it is: missing, unreadable or contradictory input."""


class ConfigError(NerfloomError):
    """A setting, a name or a configuration file is wrong."""


class CheckpointError(NerfloomError):
    """A checkpoint cannot be read or does not fit the model."""


class DivergenceError(NerfloomError):
    """Training met non-finite values too many times in a row to go on."""


def is_out_of_memory(error: BaseException) -> bool:
    """Whether memory was asked for that there is not: Python's own error, or one of torch's, which has many."""
    said = str(error)
    return isinstance(error, MemoryError) or (
        isinstance(error, RuntimeError) and ("out of memory" in said or "allocate memory" in said)
    )


def nearest(name: str, candidates: Iterable[str]) -> str:
    """A hint naming the candidates closest to a misspelt `name`, or listing all of them.

    Returns: a sentence such as ``Did you mean 'instant-ngp'?``.
    """
    candidates = sorted(candidates)
    close = difflib.get_close_matches(name, candidates, n=3, cutoff=0.5)
    if close:
        return "Did you mean " + " or ".join(repr(match) for match in close) + "?"
    return "Known: " + ", ".join(candidates) + "."


def printable(text: str) -> str:
    """Text that stays on its line and does nothing to a terminal: what cannot be printed stands there escaped."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


_BRIEF = reprlib.Repr()
_BRIEF.maxlevel = 3
_BRIEF.maxlist = _BRIEF.maxtuple = _BRIEF.maxdict = 10
_BRIEF.maxstring = _BRIEF.maxother = _BRIEF.maxlong = 60


def shown(value: Any) -> str:
    """A value for a message: one short line whatever it holds, however deep and however large it is."""
    if isinstance(value, int) and abs(value) >= 10**30:
        return "a huge whole number"
    try:
        text = printable(_BRIEF.repr(value))
    except ValueError:  # Python writes no whole number of thousands of digits
        text = f"a {type(value).__name__} that cannot be written"
    return text if len(text) <= 60 else f"{text[:57]}..."
