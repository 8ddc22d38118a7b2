"""The containers of SPZ files: a header, arrays of bytes and extensions, in versions 1 to 4.

They are specified by https://github.com/nianticlabs/spz (README.md, extensions/README.md and src/cc/load-spz.cc).

**Versions 1 to 3** are one gzip file: a header of 16 bytes (magic NGSP, version, number of Gaussians, degree,
fractional bits, flags, 0), one array an attribute, and extensions. The comment of the gzip file (RFC 1952, FCOMMENT) is
ours: it holds the settings of drawing, and other programs skip it.

**Version 4** begins with a header of 32 bytes that is not compressed: the same, where the number of arrays replaces the
0, then the offset of a table, and 12 zeros. Extensions follow, then the table, which has two 64-bit integers for each
array, its sizes with and without compression; then the arrays, each a Zstandard frame (RFC 8878). An empty array is
left out.

**An extension** is a 32-bit type, a 32-bit length, and content. Programs skip unknown ones, some with a warning. `AXES`
says that other axes are stored, and a file with them is refused. `DRAWING` is ours: in version 4 it
holds the settings of drawing.
"""

from __future__ import annotations

import gzip
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from nerfloom.base.errors import ConfigError, DataError
from nerfloom.base.extras import install_command

SpzVersion = Literal[2, 3, 4]
"""Version that can be written."""
MAGIC = b"NGSP"
HEADER = struct.Struct("<4sIIBBBB")
"""Magic, version, number of Gaussians, degree, fractional bits, flags, 0."""
LONG_HEADER = struct.Struct("<4sIIBBBBI12x")
"""Version 4: the same, with the number of arrays, then the offset of the table."""
SIZES = struct.Struct("<QQ")
"""An entry of the table: size in the file, and size of the array."""
RECORD = struct.Struct("<II")
"""The start of an extension: type and length."""
MAX_GAUSSIANS = 10_000_000
"""Maximum number of Gaussians that are written before version 4: older releases of Niantic's library read no more."""
MAX_COUNT = 2**31 - 1
"""Maximum number of Gaussians that are read, as in Niantic's library."""
MAX_RATIO = 1032
"""gzip's maximum ratio of the sizes before and after compression. Arrays of Gaussians stay far below it."""
MAX_SURPLUS = 1 << 24
"""Maximum number of bytes behind the last array of a gzip file, for extensions."""
MAX_WINDOW = 1 << 27
"""Maximum memory that a Zstandard frame may ask for, bytes."""
PIECE = 1 << 20
"""Number of bytes that are unpacked at once."""
LEVEL = 12
"""Compression level of Zstandard, as in Niantic's library."""
FCOMMENT, COMMENT_START, MAX_COMMENT_LENGTH = 16, 10, 1000
"""In the gzip header: the flags with only a comment, the offset of the comment, and its maximum length, bytes."""
EXTENDED = 2
"""Bit of the header's flags: there are extensions."""
AXES, RUB = 0xADBE0003, 4
"""Type of the extension SPZ_ADOBE_coordinate_system, and its value for the usual axes, right, up and back."""
DRAWING = 0x4E460001
"""Type of our extension: the settings of drawing, as lines of Latin-1."""


@dataclass(frozen=True)
class Packed:
    """The content of an SPZ file."""

    version: int
    """1 to 4."""
    count: int
    """Number of Gaussians, N."""
    degree: int
    """Highest degree of the harmonics, 0 to 4."""
    fraction: int
    """Fractional bits of positions, 0 to 30."""
    flags: int
    """Bits of the header."""
    arrays: Sequence[np.ndarray]
    """Six arrays of N rows of bytes: positions, opacities, colours, scales, rotations and harmonics."""
    comments: Sequence[str] = ()
    """Lines about how the Gaussians are drawn."""


def widths(version: int, degree: int) -> tuple[int, ...]:
    """Return the number of bytes of a Gaussian in each of the six arrays.

    Args:
        version: 1 to 4.
        degree: highest degree of the harmonics.
    """
    return 6 if version == 1 else 9, 1, 3, 3, 3 if version < 3 else 4, 3 * ((degree + 1) ** 2 - 1)


def packed_bytes(packed: Packed) -> bytes:
    """Return the bytes of a file.

    Args:
        packed: its content, of version 2, 3 or 4.

    Raises:
        ConfigError: if a package is missing, which version 4 needs.
    """
    arrays = [np.ascontiguousarray(array).tobytes() for array in packed.arrays]
    fields = MAGIC, packed.version, packed.count, packed.degree, packed.fraction
    comment = "\n".join(packed.comments).encode("latin-1")
    if packed.version < 4:
        content = b"".join([HEADER.pack(*fields, packed.flags, 0), *arrays])
        return _commented(gzip.compress(content, 6, mtime=0), comment)
    _need_zstandard("SPZ of version 4")
    import zstandard

    extension = RECORD.pack(DRAWING, len(comment)) + comment if comment else b""
    compressor = zstandard.ZstdCompressor(level=LEVEL, write_checksum=True)
    frames = [(compressor.compress(array), len(array)) for array in arrays if array]
    flags, table = packed.flags | (EXTENDED if comment else 0), LONG_HEADER.size + len(extension)
    sizes = [SIZES.pack(len(frame), size) for frame, size in frames]
    start = LONG_HEADER.pack(*fields, flags, len(frames), table) + extension
    return b"".join([start, *sizes, *(frame for frame, _ in frames)])


def read_packed(file: Path) -> Packed:
    """Read the content of a file of any version, decompressed.

    The memory allocated is bounded by the size of the file, for any size in its header.

    Args:
        file: path of the file.

    Raises:
        DataError: if the file cannot be read, is not an SPZ file of these versions, is truncated or damaged, or has
            other axes than usual.
        ConfigError: if a package is missing, which version 4 needs.
    """
    try:
        with file.open("rb") as stream:
            plain = stream.read(4) == MAGIC
        return _with_zstandard(file, file.read_bytes()) if plain else _with_gzip(file)
    except (gzip.BadGzipFile, zlib.error) as error:
        raise DataError(f"{file} is damaged, or not an SPZ file: copy or export it again") from error
    except EOFError as error:
        raise DataError(f"{file} is truncated: copy or export it again") from error
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror}") from error


def _need_zstandard(what: str) -> None:
    if (advice := install_command("spz")) is not None:
        raise ConfigError(f"{what} needs a package that is not installed: {advice}")


def _commented(packed: bytes, comment: bytes) -> bytes:
    """Return a gzip file with a comment."""
    start = packed[:3] + bytes([FCOMMENT]) + packed[4:COMMENT_START]
    return start + comment + b"\0" + packed[COMMENT_START:]


def _comment(packed: bytes) -> list[str]:
    """Return the lines of the comment at the start of a gzip file; none if its header has other parts."""
    text, end, _ = packed[COMMENT_START : COMMENT_START + MAX_COMMENT_LENGTH].partition(b"\0")
    return text.decode("latin-1").splitlines() if end and packed[3] == FCOMMENT else []


def _with_gzip(file: Path) -> Packed:
    with gzip.open(file, "rb") as stream:
        start = stream.read(HEADER.size)
        if start[:4] != MAGIC:
            raise DataError(f"{file} is not an SPZ file: its unpacked content does not begin with {MAGIC.decode()}")
        if len(start) < HEADER.size:
            raise DataError(f"{file} is truncated: copy or export it again")
        _, version, count, degree, fraction, flags, _ = HEADER.unpack(start)
        if version not in (1, 2, 3):
            raise DataError(f"{file} is SPZ of version {version}; gzip files have versions 1 to 3: export it again")
        _check(file, version, count, degree, fraction, file.stat().st_size)
        needed = count * sum(widths(version, degree))
        content = stream.read(needed)
        if len(content) < needed:
            raise DataError(f"{file} is truncated: its header states {count:,} Gaussians; copy or export it again")
        surplus = bytearray()
        while more := stream.read(1 << 16):  # to its end, where the checksum is
            surplus += more
            if len(surplus) > MAX_SURPLUS:
                raise DataError(f"{file} has too much behind its {count:,} Gaussians; export it again")
    with file.open("rb") as plain:
        comments = _comment(plain.read(COMMENT_START + MAX_COMMENT_LENGTH))
    if flags & EXTENDED:
        _drawing(file, bytes(surplus))
    cuts = [count * sum(widths(version, degree)[:index]) for index in range(1, 6)]
    arrays = _rows(np.split(np.frombuffer(content, np.uint8), cuts), version, count, degree)
    return Packed(version, count, degree, fraction, flags, arrays, comments)


def _rows(arrays: Sequence[np.ndarray], version: int, count: int, degree: int) -> list[np.ndarray]:
    return [array.reshape(count, width) for array, width in zip(arrays, widths(version, degree), strict=True)]


def _with_zstandard(file: Path, content: bytes) -> Packed:
    if len(content) < LONG_HEADER.size:
        raise DataError(f"{file} is truncated: copy or export it again")
    _, version, count, degree, fraction, flags, number, table = LONG_HEADER.unpack_from(content)
    if version != 4:
        raise DataError(f"{file} is SPZ of version {version}; versions 1 to 4 can be read: convert it")
    _need_zstandard(f"{file} is SPZ of version 4, and")
    _check(file, version, count, degree, fraction, len(content))
    sizes = [count * width for width in widths(version, degree)]
    start = table + SIZES.size * number
    if table < LONG_HEADER.size or start > len(content) or number != sum(size > 0 for size in sizes):
        raise DataError(f"{file} is truncated, or has another number of arrays than 5 or 6: copy or export it again")
    entries, arrays = SIZES.iter_unpack(content[table:start]), list[np.ndarray]()
    for size in sizes:
        array = b""
        if size:
            length, whole = next(entries)
            if whole != size or length > len(content) - start:
                raise DataError(f"{file} is truncated: its header states {count:,} Gaussians; copy or export it again")
            array = _unpacked(file, content[start : start + length], size)
            start += length
        arrays.append(np.frombuffer(array, np.uint8))
    comments = _drawing(file, content[LONG_HEADER.size : table]) if flags & EXTENDED else []
    return Packed(version, count, degree, fraction, flags, _rows(arrays, version, count, degree), comments)


def _unpacked(file: Path, frame: bytes, size: int) -> bytes:
    """Return the content of a Zstandard frame; the size that it states may be wrong, so it is read in pieces."""
    import zstandard

    content = bytearray()
    try:
        with zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW).stream_reader(frame) as stream:
            while len(content) <= size and (piece := stream.read(PIECE)):
                content += piece
    except zstandard.ZstdError as error:
        raise DataError(f"{file} is damaged: one of its arrays cannot be unpacked; copy or export it again") from error
    if len(content) != size:
        raise DataError(f"{file} is damaged: one of its arrays unpacks to another size; copy or export it again")
    return bytes(content)


def _check(file: Path, version: int, count: int, degree: int, fraction: int, size: int) -> None:
    """Refuse a header with numbers out of range, or with more Gaussians than the file can hold."""
    if degree > 4 or fraction > 30 or count > MAX_COUNT:
        raise DataError(
            f"{file} is damaged: its header states {count:,} Gaussians of degree {degree} with {fraction} fractional"
            f" bits, and the format has up to {MAX_COUNT:,}, 4 and 30; export it again"
        )
    if count * sum(widths(version, degree)) > MAX_RATIO * size:
        raise DataError(f"{file} is truncated: {count:,} Gaussians have more than its {size:,} bytes")


def _drawing(file: Path, extensions: bytes) -> list[str]:
    """Return the lines of our extension; none if there is none.

    Raises:
        DataError: if other axes than usual are stored.
    """
    lines, start = list[str](), 0
    while start + RECORD.size <= len(extensions):
        kind, length = RECORD.unpack_from(extensions, start)
        start += RECORD.size
        axes = int.from_bytes(extensions[start : start + min(length, 4)], "little")
        if kind == AXES and axes not in (0, RUB):
            raise DataError(f"{file} has axes that are not read, number {axes} of SPZ's; convert it to RUB, or to PLY")
        if kind == DRAWING:
            lines = extensions[start : start + min(length, MAX_COMMENT_LENGTH)].decode("latin-1").splitlines()
        start += length
    return lines
