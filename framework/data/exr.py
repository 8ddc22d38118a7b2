"""Depth in OpenEXR files (Kainz, Bogart and Stanczyk 2009): one channel of a scanline file, in plain Python.

Supported are channels of 16 and 32 bit floats and 32 bit integers, uncompressed or with RLE, ZIPS or ZIP. Other
compressions and tiles are refused by name.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from nerfloom.base.errors import DataError

MAGIC = b"\x76\x2f\x31\x01"
TILED_OR_SEVERAL = 0x200 | 0x800 | 0x1000
"""Flags of tiled, deep or multi-part files."""
TYPES: dict[int, np.dtype] = {0: np.dtype("<u4"), 1: np.dtype("<f2"), 2: np.dtype("<f4")}
"""Channel type number -> numpy type."""
ROWS = {0: 1, 1: 1, 2: 1, 3: 16}
"""Supported compression number -> rows of a block: none, RLE, ZIPS and ZIP."""
COMPRESSIONS = ("none", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB", "HTJ2K")
"""Names of compressions, by number."""
LIKELIEST = ("Z", "V", "DEPTH", "DISTANCE", "Y", "R")
"""Names of a depth channel, without layer and in capitals, most likely first."""
MAX_TEXT_LENGTH = 256
"""Maximum number of bytes of a name in the header, terminator included."""


@dataclass(frozen=True)
class ExrHeader:
    """Header of a file."""

    channels: tuple[tuple[str, np.dtype], ...]
    """Name and type of each channel, in the order of a row."""
    compression: int
    """Compression number, a key of `ROWS`."""
    box: tuple[int, int, int, int]
    """First column, first row, last column and last row."""
    start: int
    """Position of the block table in the file, bytes."""

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, pixels."""
        left, top, right, bottom = self.box
        return bottom - top + 1, right - left + 1


def read_header(content: bytes) -> ExrHeader:
    """Read the header of a file with `content`.

    Raises:
        DataError: if the content is not OpenEXR, or of an unsupported kind.
    """
    if content[:4] != MAGIC:
        raise DataError("its content is not OpenEXR")
    attributes, start = _attributes(content)
    (flags,) = struct.unpack_from("<I", content, 4)
    if flags & TILED_OR_SEVERAL:
        raise DataError("tiles, deep pixels and several parts are not supported; save one part as scanlines")
    channels, compression = _channels(attributes["channels"]), attributes["compression"][0]
    if compression not in ROWS:
        name = COMPRESSIONS[compression] if compression < len(COMPRESSIONS) else str(compression)
        raise DataError(f"its compression {name} is not supported; save it with ZIP, or as .npy")
    left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
    if left > right or top > bottom:
        raise DataError("it has no pixels")
    return ExrHeader(channels, compression, (left, top, right, bottom), start)


def depth_channel(header: ExrHeader) -> str:
    """Return the name of the depth channel in `header`: the only channel, or one with a likely name.

    Raises:
        DataError: if there are several channels and none has a likely name.
    """
    names = [name for name, _ in header.channels]
    ranked = [name for likely in LIKELIEST for name in names if name.rpartition(".")[2].upper() == likely]
    if len(names) > 1 and not ranked:
        raise DataError(f"none of its channels {', '.join(names)} looks like depth; name it Z, or save it alone")
    return names[0] if len(names) == 1 else ranked[0]


def read_channel(content: bytes, header: ExrHeader, name: str) -> np.ndarray:
    """Read the channel `name`, (H, W) float32, of a file with `content` and `header`.

    Raises:
        DataError: if a block is missing or damaged.
    """
    height, width = header.shape
    place = [known for known, _ in header.channels].index(name)
    before = width * sum(kind.itemsize for _, kind in header.channels[:place])
    row = width * sum(kind.itemsize for _, kind in header.channels)
    kind, rows = header.channels[place][1], ROWS[header.compression]
    count = -(-height // rows)
    if header.start + 8 * count > len(content):
        raise DataError("it is truncated; copy it again")
    values = np.zeros((height, width), np.float32)
    for offset in struct.unpack_from(f"<{count}Q", content, header.start):
        if offset + 8 > len(content):
            raise DataError("it is truncated; copy it again")
        first, size = struct.unpack_from("<ii", content, offset)
        first -= header.box[1]
        if not 0 <= first < height or size < 0 or offset + 8 + size > len(content):
            raise DataError("a block of rows is damaged; copy it again")
        lines = min(rows, height - first)
        data = _unpacked(content[offset + 8 : offset + 8 + size], header.compression, lines * row)
        for line in range(lines):
            values[first + line] = np.frombuffer(data, kind, width, line * row + before)
    return values


def _attributes(content: bytes) -> tuple[Mapping[str, bytes], int]:
    """Return the header's attributes by name, and the position of its end."""
    found: dict[str, bytes] = {}
    place = 8
    try:
        while content[place] != 0:
            name, place = _text(content, place)
            _, place = _text(content, place)
            (size,) = struct.unpack_from("<i", content, place)
            if size < 0 or place + 4 + size > len(content):
                raise DataError("its header is damaged; copy it again")
            found[name], place = content[place + 4 : place + 4 + size], place + 4 + size
    except (IndexError, struct.error) as error:
        raise DataError("its header is truncated; copy it again") from error
    sizes = {"channels": 19, "compression": 1, "dataWindow": 16}
    if any(len(found.get(name, b"")) < size for name, size in sizes.items()):
        raise DataError("its header lacks channels, compression or dataWindow")
    return found, place + 1


def _channels(attribute: bytes) -> tuple[tuple[str, np.dtype], ...]:
    found: list[tuple[str, np.dtype]] = []
    place = 0
    try:
        while attribute[place] != 0:
            name, place = _text(attribute, place)
            number, _, *sampling = struct.unpack_from("<iIii", attribute, place)
            place += 16
            if number not in TYPES or sampling != [1, 1]:
                raise DataError(f"its channel {name} has an unsupported type, or fewer pixels than the others")
            found.append((name, TYPES[number]))
    except (IndexError, struct.error) as error:
        raise DataError("its list of channels is damaged; copy it again") from error
    return tuple(found)


def _text(content: bytes, place: int) -> tuple[str, int]:
    """Return the text at a position, up to a zero, and the position after it."""
    end = content.find(b"\0", place, place + MAX_TEXT_LENGTH)
    if end < 0:
        raise DataError("its header is damaged; copy it again")
    return content[place:end].decode("utf-8", "replace"), end + 1


def _unpacked(block: bytes, compression: int, size: int) -> bytes:
    """Return the `size` bytes of a block; blocks that compression does not shrink are stored uncompressed."""
    if compression == 0 or len(block) == size:
        data = block
    else:
        data = _rle(block, size) if compression == 1 else _inflated(block, size)
        # Differences from the previous byte, plus 128; then bytes at even positions before those at odd ones.
        sums = np.frombuffer(data, np.uint8).astype(np.int64)
        sums[1:] -= 128
        parts = sums.cumsum().astype(np.uint8)
        ordered = np.empty_like(parts)
        half = (len(parts) + 1) // 2
        ordered[0::2], ordered[1::2] = parts[:half], parts[half:]
        data = ordered.tobytes()
    if len(data) != size:
        raise DataError("a block of rows is damaged; copy it again")
    return data


def _inflated(block: bytes, size: int) -> bytes:
    """Return the data inflated by zlib, at most one byte more than expected."""
    try:
        return zlib.decompressobj().decompress(block, size + 1)
    except zlib.error as error:
        raise DataError("a block of rows is damaged; copy it again") from error


def _rle(block: bytes, size: int) -> bytes:
    """Decode runs: n >= 0 and a byte to repeat n + 1 times, or n < 0 and -n bytes."""
    data, place = bytearray(), 0
    while place < len(block) - 1 and len(data) <= size:
        length = int.from_bytes(block[place : place + 1], "little", signed=True)
        if length < 0:
            data += block[place + 1 : place + 1 - length]
            place += 1 - length
        else:
            data += block[place + 1 : place + 2] * (length + 1)
            place += 2
    return bytes(data)
