"""Where a line may not break: in short words of code that have hyphens, and between a number and its unit.

Browsers break after every hyphen, also between the two of a flag: on a phone `--max-seconds` then stands on two lines.
"""

from __future__ import annotations

import html
import re

TAG = re.compile(r"(<[^>]*>)")
CODE = re.compile(r"<(/?)(?:pre|code)\b")
HYPHENED = re.compile(r"[^\s]*-[^\s]*")
FIRST = re.compile(r"(--\w+|)(.*)", re.DOTALL)
UNIT = re.compile(r"(?<=\d) (?=(?:dB|s|ms|min|h|GB|MB|GiB|MiB)\b(?!/)|%)|(?<=±) ")
LONGEST = 18
"""Characters of a word that is kept whole; in a longer one, which a phone's columns do not hold, only `--first` is."""


def keep_together(content: str) -> str:
    """Return a page's HTML with short words of code, and numbers with their units, kept on one line.

    The text is the same: words are wrapped into elements of the class `whole`, and spaces become unbreakable.

    Args:
        content: HTML of a page; preformatted text in it is left as it is.
    """
    depth, parts, preformatted = 0, TAG.split(content), False
    for i, part in enumerate(parts):
        if tag := CODE.match(part):
            depth += -1 if tag[1] else 1
            preformatted = depth > 0 and (preformatted or part.startswith("<pre"))
        elif not part.startswith("<"):
            if depth == 0:
                parts[i] = UNIT.sub("\N{NO-BREAK SPACE}", part)
            elif not preformatted:
                parts[i] = HYPHENED.sub(lambda found: _whole(found[0]), part)
    return "".join(parts)


def _whole(word: str) -> str:
    first, rest = (word, "") if len(html.unescape(word)) <= LONGEST else FIRST.fullmatch(word).groups()
    return f'<span class="whole">{first}</span>{rest}' if first else word
