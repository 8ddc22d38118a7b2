"""Colours that users name."""

from __future__ import annotations

import re

from nerfloom.base.errors import ConfigError, shown

NAMES: dict[str, tuple[float, float, float]] = {
    "black": (0.0, 0.0, 0.0),
    "grey": (0.5, 0.5, 0.5),
    "white": (1.0, 1.0, 1.0),
}
"""Colours by name."""


def color_of(text: str) -> tuple[float, float, float]:
    """Return the red, green and blue, 0 to 1, of a colour `text`: black, grey, white or hexadecimal #RRGGBB.

    Raises:
        ConfigError: if it is no such colour.
    """
    if text in NAMES:
        return NAMES[text]
    if not re.fullmatch(r"#[0-9a-fA-F]{6}", text):
        raise ConfigError(f"{shown(text)} is not a colour: use {', '.join(NAMES)}, or #RRGGBB such as #e8e8ea")
    red, green, blue = (int(text[start : start + 2], 16) / 255 for start in (1, 3, 5))
    return red, green, blue
