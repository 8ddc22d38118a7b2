"""OpenEXR files of scanlines, written from the format's description."""

import itertools
import struct
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

TYPES = {"float16": 1, "float32": 2, "uint32": 0}
NONE, RLE, ZIPS, ZIP, PIZ = range(5)


def write_exr(file: Path, channels: Mapping[str, np.ndarray], compression: int = ZIP, flags: int = 0) -> None:
    """Write channels (H, W), which a reader finds in the order of their names; the first pixel is at (-3, 5)."""
    names = sorted(channels)
    height, width = channels[names[0]].shape
    box = struct.pack("<4i", -3, 5, width - 4, height + 4)
    listed = b"".join(
        name.encode() + b"\0" + struct.pack("<iIii", TYPES[channels[name].dtype.name], 0, 1, 1) for name in names
    )
    attributes = {
        "channels": ("chlist", listed + b"\0"),
        "compression": ("compression", bytes([compression])),
        "dataWindow": ("box2i", box),
        "displayWindow": ("box2i", box),
        "lineOrder": ("lineOrder", b"\0"),
    }
    head = b"\x76\x2f\x31\x01" + struct.pack("<I", 2 | flags)
    for name, (kind, value) in attributes.items():
        head += name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value
    head += b"\0"
    blocks = []
    rows = 16 if compression == ZIP else 1
    for first in range(0, height, rows):
        lines = range(first, min(first + rows, height))
        plain = b"".join(
            channels[name][line].astype(channels[name].dtype).tobytes() for line in lines for name in names
        )
        packed = PACKERS[compression](plain)
        data = packed if len(packed) < len(plain) else plain
        blocks.append(struct.pack("<ii", first + 5, len(data)) + data)
    starts = itertools.accumulate(map(len, blocks[:-1]), initial=len(head) + 8 * len(blocks))
    file.write_bytes(head + b"".join(struct.pack("<Q", start) for start in starts) + b"".join(blocks))


def _differences(data: bytes) -> bytes:
    """Even bytes before odd ones, and each as its difference from the one before, plus 128."""
    parts = data[0::2] + data[1::2]
    return bytes([parts[0], *((b - a + 128) % 256 for a, b in itertools.pairwise(parts))])


def _runs(data: bytes) -> bytes:
    """Runs of up to 128 equal bytes, and else up to 127 bytes as they are, behind their negative number."""
    packed, plain = bytearray(), bytearray()
    for value, group in itertools.groupby(_differences(data)):
        count = len(list(group))
        if count < 3:
            plain += bytes([value]) * count
            continue
        packed += _as_they_are(plain)
        plain.clear()
        for length in [128] * (count // 128) + [count % 128] * (count % 128 > 0):
            packed += bytes([length - 1, value])
    return bytes(packed + _as_they_are(plain))


def _as_they_are(data: bytes) -> bytes:
    parts = [bytes(data[start : start + 127]) for start in range(0, len(data), 127)]
    return b"".join(struct.pack("b", -len(part)) + part for part in parts)


PACKERS: dict[int, Callable[[bytes], bytes]] = {
    NONE: bytes,
    RLE: _runs,
    ZIPS: lambda data: zlib.compress(_differences(data)),
    ZIP: lambda data: zlib.compress(_differences(data)),
    PIZ: bytes,
}
