"""The user's cache folder."""

from __future__ import annotations

import os
from pathlib import Path


def cache_folder() -> Path:
    """Return the cache folder: NERFLOOM_CACHE, else `nerfloom` in XDG_CACHE_HOME, else in ~/.cache."""
    if "NERFLOOM_CACHE" in os.environ:
        return Path(os.environ["NERFLOOM_CACHE"])
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "nerfloom"
