"""Text of files, commands and errors in the panel, which shows Markdown."""

from __future__ import annotations

KEPT = frozenset(" -_.,:;!?/%()'\"=–±")
"""Characters other than letters and digits that are shown. Markdown and HTML interpret none of them but underscores."""


def plain(text: str) -> str:
    """Return Markdown that shows `text` literally. Question marks replace characters that could be interpreted."""
    return "".join(letter if letter.isalnum() or letter in KEPT else "?" for letter in text).replace("_", r"\_")
