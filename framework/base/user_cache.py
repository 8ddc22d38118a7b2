"""The user's cache folder."""

from __future__ import annotations

import os
from pathlib import Path

from nerfloom.base.errors import ConfigError


def cache_folder() -> Path:
    """Return the cache folder: NERFLOOM_CACHE, else `nerfloom` in XDG_CACHE_HOME, else in ~/.cache.

    Raises:
        ConfigError: if the user has no home folder, as in some containers.
    """
    if "NERFLOOM_CACHE" in os.environ:
        return Path(os.environ["NERFLOOM_CACHE"])
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "nerfloom"
    except RuntimeError as error:
        raise ConfigError("this user has no home folder: set the variable NERFLOOM_CACHE to a folder") from error
