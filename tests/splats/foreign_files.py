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
