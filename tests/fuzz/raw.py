"""Damage to bytes of any meaning: as by disks, networks and careless programs, and numbers at their ends."""

import struct
from random import Random

from tests.fuzz.values import REAL, WHOLE

HEAD = 64
"""Bytes at the beginning, where formats keep their counts and sizes."""


def place(random: Random, content: bytes) -> int:
    """Anywhere, and half of the time near the beginning."""
    return random.randrange(min(len(content), HEAD if random.random() < 0.5 else len(content)) + 1)


def stretch(random: Random, content: bytes) -> slice:
    """A part of the content, mostly short."""
    start = place(random, content)
    return slice(start, start + random.choice((1, 1, 2, 4, 8, 20, 100, len(content))))


def flip_bits(random: Random, content: bytes) -> bytes:
    changed = bytearray(content)
    for _ in range(random.choice((1, 1, 1, 2, 8, 40))):
        if changed:
            changed[place(random, content) % len(changed)] ^= 1 << random.randrange(8)
    return bytes(changed)


def cut_short(random: Random, content: bytes) -> bytes:
    return content[: random.randrange(max(len(content), 1))]


def empty(random: Random, content: bytes) -> bytes:
    return b""


def leave_out(random: Random, content: bytes) -> bytes:
    part = stretch(random, content)
    return content[: part.start] + content[part.stop :]


def repeat(random: Random, content: bytes) -> bytes:
    part = stretch(random, content)
    return content[: part.start] + content[part] * random.choice((2, 2, 3, 1000)) + content[part.stop :]


def write_over(random: Random, content: bytes) -> bytes:
    part = stretch(random, content)
    length = len(content[part])
    other = random.choice((bytes(length), b"\xff" * length, random.randbytes(length), b" " * length))
    return content[: part.start] + other + content[part.stop :]


def splice(random: Random, content: bytes) -> bytes:
    """A part comes twice, the second time elsewhere."""
    start, part = place(random, content), stretch(random, content)
    return content[:start] + content[part] + content[start:]


def extreme_number(random: Random, content: bytes) -> bytes:
    """A count, a size or a coordinate, of any width and either order of bytes."""
    order, start = random.choice("<>"), place(random, content)
    if random.random() < 0.7:
        kind = random.choice("BHIQ")
        number = struct.pack(order + kind, random.choice(WHOLE) % 2 ** (8 * struct.calcsize(kind)))
    else:
        value = random.choice(REAL)
        number = struct.pack(order + "d", value) if random.random() < 0.7 else _single(order, value)
    return content[:start] + number + content[start + len(number) :]


def _single(order: str, value: float) -> bytes:
    try:
        return struct.pack(order + "f", value)
    except OverflowError:
        return struct.pack(order + "f", float("inf"))


RAW = (flip_bits, flip_bits, cut_short, empty, leave_out, repeat, write_over, splice, extreme_number, extreme_number)
