"""Damage to images: headers that promise more pixels than memory has, and files of another format under the name."""

import io
import struct
import zlib
from collections.abc import Callable
from functools import cache
from random import Random

import numpy as np
from PIL import Image

from tests.fuzz.arrays import pickled
from tests.fuzz.raw import RAW

SIGNATURE = b"\x89PNG\r\n\x1a\n"
SIDES = (0, 1, 2, 3, 80, 4000, 13_000, 100_000, 2**16, 2**31 - 1, 2**32 - 1)
"""Claimed sides of an image that has at most forty pixels on a side."""
Chunk = tuple[bytes, bytes]
"""Its kind of four letters, and its content."""


def chunks(content: bytes) -> list[Chunk]:
    """The chunks of a PNG, as far as it is valid."""
    found, start = [], len(SIGNATURE)
    while content.startswith(SIGNATURE) and start + 12 <= len(content):
        (length,) = struct.unpack_from(">I", content, start)
        found.append((content[start + 4 : start + 8], content[start + 8 : start + 8 + length]))
        start += 12 + length
    return found


def joined(parts: list[Chunk]) -> bytes:
    """A PNG with right lengths and checksums."""
    out = [SIGNATURE]
    for kind, body in parts:
        out += [struct.pack(">I", len(body)), kind, body, struct.pack(">I", zlib.crc32(kind + body))]
    return b"".join(out)


def other_size(random: Random, content: bytes) -> bytes:
    """Another size of a PNG: a small file may claim to be 100,000 pixels wide and high."""
    parts = chunks(content)
    if not parts or len(parts[0][1]) != 13:
        return content
    width, height = random.choice(SIDES), random.choice(SIDES)
    if random.random() < 0.3:
        width = height = 100_000
    return joined([(parts[0][0], struct.pack(">II", width, height) + parts[0][1][8:]), *parts[1:]])


def other_depth(random: Random, content: bytes) -> bytes:
    """Another format of a PNG: bits, colours, compression, filter, interlacing."""
    parts = chunks(content)
    if not parts or len(parts[0][1]) != 13:
        return content
    header = bytearray(parts[0][1])
    header[random.randrange(8, 13)] = random.choice((0, 1, 2, 3, 4, 6, 8, 16, 255))
    return joined([(parts[0][0], bytes(header)), *parts[1:]])


def other_chunks(random: Random, content: bytes) -> bytes:
    """Other chunks of a PNG: missing, twice, in another order, or unknown ones."""
    parts = chunks(content)
    if not parts:
        return content
    index = random.randrange(len(parts))
    more = random.choice(
        [
            (b"acTL", struct.pack(">II", random.choice((0, 1, 3, 2**31)), 0)),
            (b"PLTE", random.randbytes(random.choice((0, 1, 3, 768, 3000)))),
            (b"tRNS", random.randbytes(random.choice((0, 1, 2, 6, 256)))),
            (b"iCCP", b"x\0\0" + zlib.compress(bytes(2_000_000))),
            (b"zTXt", b"x\0\0" + zlib.compress(bytes(2_000_000))),
            (b"eXIf", random.randbytes(30)),
            (b"IDAT", zlib.compress(bytes(1_000_000))),
            (b"quux", b""),
        ]
    )
    changed: dict[str, Callable[[], list[Chunk]]] = {
        "missing": lambda: parts[:index] + parts[index + 1 :],
        "twice": lambda: parts[:index] + parts[index : index + 1] + parts[index:],
        "more": lambda: [*parts[:index], more, *parts[index:]],
        "in its place": lambda: [*parts[:index], more, *parts[index + 1 :]],
    }
    return joined(changed[random.choice(sorted(changed))]())


@cache
def disguises() -> tuple[bytes, ...]:
    """Files of other formats, or of other kinds of the same one."""
    noise = np.random.default_rng(0).integers(0, 256, (20, 20, 4), dtype=np.uint8)
    grey = [Image.fromarray(np.roll(noise[..., 0], index, 0)) for index in range(3)]
    palette = Image.fromarray(noise[..., :3]).convert("P")
    saved = [
        _saved(grey[0], "GIF", save_all=True, append_images=grey[1:]),
        _saved(grey[0], "PNG", save_all=True, append_images=grey[1:]),
        _saved(grey[0], "WEBP", save_all=True, append_images=grey[1:]),
        _saved(grey[0], "TIFF", save_all=True, append_images=grey[1:]),
        _saved(Image.fromarray(noise), "PNG"),
        _saved(Image.fromarray(noise[..., :3]), "JPEG"),
        _saved(Image.fromarray(noise[..., :3]).convert("CMYK"), "JPEG"),
        _saved(Image.fromarray(noise[..., :3]), "BMP"),
        _saved(Image.fromarray(noise[..., :3]), "PPM"),
        _saved(Image.merge("LA", grey[:2]), "PNG"),
        _saved(Image.fromarray(noise[..., 0].astype(np.uint16) * 200), "PNG"),
        _saved(Image.fromarray(noise[..., 0].astype(np.float32)), "TIFF"),
        _saved(grey[0].convert("1"), "PNG"),
        _saved(palette, "PNG", transparency=3),
        _saved(palette, "GIF", transparency=3),
    ]
    return (
        *saved,
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 20 20\n%%EndComments\n(proof) (w) file closefile\n%%EOF\n",
        b"<svg xmlns='http://www.w3.org/2000/svg' width='20' height='20'/>",
        b"P6 100000 100000 255\n" + bytes(1200),
        b"P7\nWIDTH 20\nHEIGHT 20\nDEPTH 3\nMAXVAL 255\nTUPLTYPE RGB\nENDHDR\n" + bytes(1200),
        b"BM" + struct.pack("<IIIIiiHH", 1254, 0, 54, 40, 100_000, 100_000, 1, 24) + bytes(24 + 1200),
        b"GIF89a" + struct.pack("<HHBBB", 65535, 65535, 0, 0, 0) + b";",
        b"PK\x03\x04" + bytes(30),
        b"%PDF-1.4\n",
        b"text",
    )


def _saved(image: Image.Image, kind: str, **options: object) -> bytes:
    file = io.BytesIO()
    image.save(file, kind, **options)
    return file.getvalue()


def disguised(random: Random, content: bytes) -> bytes:
    return random.choice(disguises())


PICTURE = (
    other_size, other_size, other_size, other_depth, other_chunks, other_chunks, disguised, disguised, disguised,
    pickled, *RAW,
)  # fmt: skip
