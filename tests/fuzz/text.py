"""Damage to text: numbers that are none, lines that are missing or too many, letters that nobody expects."""

import re
from random import Random

from tests.fuzz.values import DEPTHS, LETTERS, NAMES, NUMBERS

NUMBER = re.compile(r"[-+]?\d[\w.+-]*")


def decoded(content: bytes) -> str:
    return content.decode("utf-8", "surrogateescape")


def encoded(text: str) -> bytes:
    """Halves of characters are written as they are, which no reader of UTF-8 takes."""
    return text.encode("utf-8", "surrogatepass" if "\ud800" in text else "surrogateescape")


def other_number(random: Random, content: bytes) -> bytes:
    text = decoded(content)
    found = list(NUMBER.finditer(text))
    if not found:
        return content
    which = random.choice(found)
    return encoded(text[: which.start()] + random.choice(NUMBERS) + text[which.end() :])


def other_word(random: Random, content: bytes) -> bytes:
    words = re.split(r"(\s)", decoded(content))
    words[random.randrange(len(words))] = random.choice(NAMES)
    return encoded("".join(words))


def lose_line(random: Random, content: bytes) -> bytes:
    lines = content.splitlines(keepends=True) or [b""]
    lines.pop(random.randrange(len(lines)))
    return b"".join(lines)


def repeat_line(random: Random, content: bytes) -> bytes:
    lines = content.splitlines(keepends=True) or [b""]
    index = random.randrange(len(lines))
    lines[index] *= random.choice((2, 3, 100))
    return b"".join(lines)


def swap_lines(random: Random, content: bytes) -> bytes:
    lines = content.splitlines(keepends=True) or [b""]
    first, second = (random.randrange(len(lines)) for _ in range(2))
    lines[first], lines[second] = lines[second], lines[first]
    return b"".join(lines)


def strange_letter(random: Random, content: bytes) -> bytes:
    text = decoded(content)
    start = random.randrange(len(text) + 1)
    return encoded(text[:start] + random.choice(LETTERS) + text[start:])


def no_text(random: Random, content: bytes) -> bytes:
    """Bytes that are no UTF-8."""
    start = random.randrange(len(content) + 1)
    return content[:start] + random.choice((b"\xff", b"\xc3", b"\xff\xfe", b"\xed\xa0\x80")) + content[start:]


def long_line(random: Random, content: bytes) -> bytes:
    start = random.randrange(len(content) + 1)
    return content[:start] + random.choice((b"a", b" ", b"9", b"\t", b"-")) * 50_000 + content[start:]


def deep_text(random: Random, content: bytes) -> bytes:
    start = random.randrange(len(content) + 1)
    opened = random.choice((b"[", b'{"a":', b"- ", b"? ", b"((")) * random.choice(DEPTHS)
    return content[:start] + opened + content[start:]


TEXT = (
    other_number, other_number, other_number, other_word, other_word, lose_line, repeat_line, swap_lines,
    strange_letter, no_text, long_line, deep_text,
)  # fmt: skip
