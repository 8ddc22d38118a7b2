"""Errors a user can act on: one line that says what, where and what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class NerfloomError(ValueError):
    """Base of every error that the command line prints as one line, without a traceback."""


class DataError(NerfloomError):
    """The data set cannot be used as it is: missing, unreadable or contradictory input."""


class ConfigError(NerfloomError):
    """A setting, a name or a configuration file is wrong."""


class CheckpointError(NerfloomError):
    """A checkpoint cannot be read or does not fit the model."""


class DivergenceError(NerfloomError):
    """Training met non-finite values too many times in a row to go on."""


def nearest(name: str, candidates: Iterable[str]) -> str:
    """A hint naming the candidates closest to a misspelt `name`, or listing all of them.

    Returns: a sentence such as ``Did you mean 'instant-ngp'?``.
    """
    candidates = sorted(candidates)
    close = difflib.get_close_matches(name, candidates, n=3, cutoff=0.5)
    if close:
        return "Did you mean " + " or ".join(repr(match) for match in close) + "?"
    return "Known: " + ", ".join(candidates) + "."
