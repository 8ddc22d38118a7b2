"""Text of files, commands and errors in the panel, which shows Markdown."""

from __future__ import annotations

KEPT = frozenset(" -_.,:;!?/%()'\"=–±")
"""Characters other than letters and digits that are shown. Markdown and HTML interpret none of them but underscores."""


def plain(text: str) -> str:
    """Return the Markdown of a `text` that is shown as it is, with question marks for what could be interpreted."""
    return "".join(letter if letter.isalnum() or letter in KEPT else "?" for letter in text).replace("_", r"\_")
