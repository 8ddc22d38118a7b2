"""Files of Gaussians as other programs write them, number by number from the formats' descriptions."""

import math
import struct
from pathlib import Path

from nerfloom.splats.gaussians import Gaussians

DC = 0.28209479177387814


def clipped(value: float, most: int) -> int:
    return min(max(math.floor(value + 0.5), 0), most)


def sigmoid(value: float) -> float:
    return 1 / (1 + math.exp(-value))


def write_splat(file: Path, gaussians: Gaussians) -> None:
    """A .splat file."""
    rows = []
    for g in (gaussians[i : i + 1].map(lambda values: values[0]) for i in range(len(gaussians))):
        colors = [clipped(255 * (0.5 + DC * value), 255) for value in g.colors.tolist()]
        turn = [clipped(128 + 128 * value, 255) for value in (g.rotations / g.rotations.norm()).tolist()]
        opacity = clipped(255 * sigmoid(float(g.logits)), 255)
        rows.append(struct.pack("<6f8B", *g.means.tolist(), *g.log_scales.exp().tolist(), *colors, opacity, *turn))
    file.write_bytes(b"".join(rows))


def rotation_word(quaternion: list[float]) -> int:
    largest = max(range(4), key=lambda i: abs(quaternion[i]))
    length = math.copysign(math.sqrt(sum(q * q for q in quaternion)), quaternion[largest])
    word = largest
    for i in range(4):
        if i != largest:
            word = word << 10 | clipped(1023 * (quaternion[i] / length / math.sqrt(2) + 0.5), 1023)
    return word


def write_compressed(file: Path, gaussians: Gaussians, colors: bool = True, comments: tuple[str, ...] = ()) -> None:
    """A compressed PLY file; without `colors` its chunks say nothing of them, and they are from 0 to 1."""
    ends, words, harmonics = [], [], []
    shades = 0.5 + DC * gaussians.colors
    for start in range(0, len(gaussians), 256):
        chunk = slice(start, start + 256)
        row = []
        for values in (gaussians.means[chunk], gaussians.log_scales[chunk], shades[chunk]):
            row += [values.amin(0).tolist(), values.amax(0).tolist()]
        if not colors:
            row[4:] = [[0.0] * 3, [1.0] * 3]
        ends.append(struct.pack(f"<{18 if colors else 12}f", *[x for part in row[: 6 if colors else 4] for x in part]))
        for i in range(start, min(start + 256, len(gaussians))):

            def share(value: float, kind: int, axis: int, row: list[list[float]] = row) -> float:
                low, high = row[2 * kind][axis], row[2 * kind + 1][axis]
                return (value - low) / (high - low) if high > low else 0.0

            def three(values: list[float], kind: int) -> int:
                x, y, z = (share(value, kind, axis) for axis, value in enumerate(values))
                return clipped(2047 * x, 2047) << 21 | clipped(1023 * y, 1023) << 11 | clipped(2047 * z, 2047)

            color = 0
            for value in [
                *(share(v, 2, c) for c, v in enumerate(shades[i].tolist())),
                sigmoid(float(gaussians.logits[i])),
            ]:
                color = color << 8 | clipped(255 * value, 255)
            mean, scale = three(gaussians.means[i].tolist(), 0), three(gaussians.log_scales[i].tolist(), 1)
            words.append(struct.pack("<4I", mean, rotation_word(gaussians.rotations[i].tolist()), scale, color))
            rest = gaussians.harmonics[i].flatten().tolist()
            harmonics.append(bytes(min(max(math.floor(256 * (f / 8 + 0.5)), 0), 255) for f in rest))
    names = [f"{end}{axis}" for axes in ("xyz", "scale") for end in ("min_", "max_") for axis in _axes(axes)]
    names += [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"] if colors else []
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {text}" for text in comments)]
    lines += [f"element chunk {len(ends)}", *(f"property float {name}" for name in names)]
    lines += [f"element vertex {len(gaussians)}"]
    lines += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    if gaussians.harmonics.shape[2]:
        lines += [f"element sh {len(gaussians)}"]
        lines += [f"property uchar f_rest_{k}" for k in range(3 * gaussians.harmonics.shape[2])]
    file.write_bytes("\n".join([*lines, "end_header", ""]).encode() + b"".join([*ends, *words, *harmonics]))


def _axes(name: str) -> list[str]:
    return list("xyz") if name == "xyz" else [f"scale_{axis}" for axis in "xyz"]


def write_ksplat(file: Path, gaussians: Gaussians, level: int, block: float = 5.0, bucket_size: int = 8) -> list[int]:
    """A .ksplat file of two sections, each with half of the Gaussians, of degree 2 at most; returns their order."""
    rest = gaussians.harmonics.flatten().tolist() or [0.0]
    low, high = min(rest), max(rest)
    half = len(gaussians) // 2
    sections, headers, order = [], [], []
    for members in (range(half), range(half, len(gaussians))):
        full, partial = ksplat_buckets(gaussians.means[members.start : members.stop].tolist(), block, bucket_size)
        buckets = [*full, *partial]
        numbers = b"".join(struct.pack("<I", len(bucket)) for _, bucket in partial)
        centers = b"".join(struct.pack("<3f", *center) for center, _ in buckets)
        rows = []
        for center, bucket in buckets:
            for index in bucket:
                order.append(members.start + index)
                rows.append(ksplat_row(gaussians[order[-1] : order[-1] + 1], level, center, block, low, high))
        content = (numbers + centers if level else b"") + b"".join(rows)
        header = bytearray(1024)
        struct.pack_into("<2I", header, 0, len(rows), len(rows))
        struct.pack_into("<H", header, 40, gaussians.degree)
        struct.pack_into("<I", header, 28, len(content))
        if level:
            struct.pack_into("<2IfH", header, 8, bucket_size, len(buckets), block, 12)
            struct.pack_into("<I", header, 24, 32767)
            struct.pack_into("<2I", header, 32, len(full), len(partial))
        headers.append(bytes(header))
        sections.append(content)
    start = bytearray(4096)
    struct.pack_into("<4B4IH", start, 0, 0, 1, 0, 0, 2, 2, len(order), len(order), level)
    struct.pack_into("<2f", start, 36, low, high)
    file.write_bytes(b"".join([bytes(start), *headers, *sections]))
    return order


Bucket = tuple[list[float], list[int]]
"""Centre, and the Gaussians in it."""


def ksplat_buckets(points: list[list[float]], block: float, most: int) -> tuple[list[Bucket], list[Bucket]]:
    """The full buckets and the others, of cubes with a side of `block`."""
    low = [min(point[axis] for point in points) for axis in range(3)]
    full: list[Bucket] = []
    partial: dict[tuple[int, ...], Bucket] = {}
    for index, point in enumerate(points):
        cell = tuple(math.floor((point[axis] - low[axis]) / block) for axis in range(3))
        center = [cell[axis] * block + low[axis] + block / 2 for axis in range(3)]
        bucket = partial.setdefault(cell, (center, []))
        bucket[1].append(index)
        if len(bucket[1]) >= most:
            full.append(partial.pop(cell))
    return full, list(partial.values())


def ksplat_row(one: Gaussians, level: int, center: list[float], block: float, low: float, high: float) -> bytes:
    """A Gaussian in a bucket."""
    g = one.map(lambda values: values[0])
    colors = [255 * (0.5 + DC * value) for value in g.colors.tolist()] + [255 * sigmoid(float(g.logits))]
    color = struct.pack("<4B", *(min(max(math.floor(value), 0), 255) for value in colors))
    turn, sizes = (g.rotations / g.rotations.norm()).tolist(), g.log_scales.exp().tolist()
    # All of a degree's red before its green before its blue.
    rest = [*g.harmonics[:, :3].flatten().tolist(), *g.harmonics[:, 3:].flatten().tolist()]
    if level == 0:
        return struct.pack("<10f", *g.means.tolist(), *sizes, *turn) + color + struct.pack(f"<{len(rest)}f", *rest)
    factor = 32767 / (block / 2)
    offsets = [a - b for a, b in zip(g.means.tolist(), center, strict=True)]
    steps = [min(max(math.floor(factor * offset + 0.5) + 32767, 0), 65535) for offset in offsets]
    start = struct.pack("<3H7e", *steps, *sizes, *turn) + color
    if level == 1:
        return start + struct.pack(f"<{len(rest)}e", *rest)
    return start + bytes(min(max(math.floor(255 * (v - low) / (high - low)), 0), 255) for v in rest)
