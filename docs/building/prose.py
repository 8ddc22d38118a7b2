"""Find words and shapes of sentences that we decided against: `python docs/building/prose.py`.

`RULES` is the whole list. A rule is worth its place if it finds sentences that stop a reader, and no others. Code,
equations, headings and addresses are not read; cells of tables are.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
RULES = {
    r"(?:^|[.!?]\)? |\*\*)(What|Whatever|Of|By|That)\b(?![^.!?]*\?)": "begin the sentence with a named subject",
    r"\b((?:of|by|from|with|at|for|after|above|below|under|without|behind|beyond|through) (?:which|whom))\b": (
        "make two sentences"
    ),
    r"\b(whose\b[^.!?;|]*\bwhose)\b": "make two sentences",
    r"\b(so many|as (?:many|much) as)\b": "say how many",
    r"\b(whatever)\b": "say: for every, or: in any",
    r"\b(what (?:is|are) (?:not|left|missing|there|in|inside|outside|above|below|behind|between))\b": "name the thing",
    r"\b((?:is|are|was|were) of no use)\b": "say: has no effect, or: cannot be used",
    r"\b(for want of|for lack of)\b": "say: without, or: because there is no",
    r"\b(at the (?:most|least))\b": "say: at most, or: at least",
    r"\b((?:there|where|here)(?:by|of|in|upon|with))\b": "name the thing",
    r"\b(in order to|due to the fact that|prior to|utili[sz]es?)\b": "say: to, because, before, or: uses",
    r"\b(obviously|of course|simply|easily)\b": "leave the word out",
    r"\b(the the|a a|of of|to to|is is|and and|in in)\b": "a word stands twice",
}
"""Pattern, in which a space may be a line's end -> what to do instead. The message quotes the group."""
UNREAD = re.compile(r"^```.*?^```$|<!--.*?-->|^\$\$.*?\$\$$|^#+ [^\n]*$", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"(`+).+?\1|\$[^$]+\$|(?<=\])\([^)]*\)", re.DOTALL)
PART = re.compile(r"(\n[ \t]*\n|\n[ \t]*(?=(?:[-*]|\d+\.) |\|)|\|)")
"""Where a sentence ends without a point: at a paragraph, an item of a list, and a cell of a table."""


def problems(text: str) -> list[tuple[int, str]]:
    """Return the line and a message for each place of a page that breaks a rule.

    Args:
        text: the Markdown.
    """
    text = CODE.sub(lambda found: _blank(found[0], "x"), UNREAD.sub(lambda found: _blank(found[0], "."), text))
    found: list[tuple[int, str]] = []
    number = 1
    for part in PART.split(text):
        words = re.sub(r"^\s*(?:(?:[-*]|\d+\.) +)?", "", part)
        first = number + part[: len(part) - len(words)].count("\n")
        for pattern, advice in RULES.items():
            for match in re.finditer(pattern.replace(" ", r"\s+"), words):
                quoted = " ".join(match[1].split())
                found.append((first + words[: match.start(1)].count("\n"), f"'{quoted}': {advice}"))
        number += part.count("\n")
    return sorted(found)


def _blank(text: str, word: str) -> str:
    """Return a word in place of a text, with as many line ends."""
    return word + "\n" * text.count("\n")


def pages() -> list[Path]:
    """Return the pages that are read: all of docs, and those at the root of the repository."""
    return sorted({*(ROOT / "docs").rglob("*.md"), *ROOT.glob("*.md")})


def main() -> None:
    """Check all pages; the exit status is 1 if one breaks a rule."""
    read = pages()
    wrong = [
        f"{page.relative_to(ROOT)}:{line}: {message}"
        for page in read
        for line, message in problems(page.read_text(encoding="utf-8"))
    ]
    print(f"{len(read)} pages, {len(RULES)} rules of prose, {len(wrong)} broken", *wrong, sep="\n")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
