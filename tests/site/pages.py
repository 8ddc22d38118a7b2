"""The documents, their blocks of code, and the commands in them."""

import re
import shlex
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = sorted([*(ROOT / "docs").rglob("*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"])
FENCE = re.compile(r"^```([\w-]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`(ns-[a-z-]+ [^`]*--[^`]*)`")
COMMANDS = re.compile(r"^(ns-[\w-]+|make|pip|pytest|python3?|torchrun|export|nerfbaselines|[A-Z_]+=\S+ .+)( |$)")
UNFINISHED = re.compile(
    r"\.\.\.|[{<]|\b(METHOD|PATH|RUN|FILE|DATA|WHAT|NAME)\b|--help$|--data DIR|--[a-z-]+$|^ns-train --"
)
"""Marks of a command in a sentence that stands for many."""


@dataclass(frozen=True)
class Block:
    """A fenced block."""

    page: str
    line: int
    language: str
    text: str

    @property
    def where(self) -> str:
        return f"{self.page}:{self.line}"


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page, in their order."""
    text, name = page.read_text(encoding="utf-8"), str(page.relative_to(ROOT))
    return [Block(name, text[: m.start(2)].count("\n") + 1, m[1], m[2]) for m in FENCE.finditer(text)]


def is_shell(block: Block) -> bool:
    """Whether a block holds commands: one that begins with one."""
    return block.language in ("sh", "bash") or (not block.language and bool(COMMANDS.match(block.text)))


def commands(page: Path) -> list[tuple[str, str]]:
    """Where each command of a page stands, and the command."""
    found = []
    for block in filter(is_shell, blocks(page)):
        text = block.text.replace("\\\n", "  ")
        for number, line in enumerate(text.splitlines()):
            for part in line.split(" && "):
                if part.strip() and not part.lstrip().startswith("#"):
                    found.append((f"{block.page}:{block.line + number}", part.strip()))
    name, text = str(page.relative_to(ROOT)), FENCE.sub("", page.read_text(encoding="utf-8"))
    found += [(name, command) for command in INLINE.findall(text) if not UNFINISHED.search(command)]
    return found


def words_of(command: str) -> list[str]:
    """The words of a command, without its comment and without variables set in front of it."""
    words = shlex.split(command.replace("$(which ns-train)", "ns-train"), comments=True)
    while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
        words = words[1:]
    return words
