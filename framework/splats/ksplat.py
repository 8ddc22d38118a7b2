"""Gaussians in KSPLAT files, which GaussianSplats3D writes.

Version 0.1 of the format is documented by https://github.com/mkkellogg/GaussianSplats3D (src/loaders/SplatBuffer.js). A
header of 4,096 bytes states the number of sections and of Gaussians, a compression level, and the range of harmonics.
A header of 1,024 bytes for each section follows, then the sections. A section has the lengths of its buckets that are
not full, the buckets' centres, and the Gaussians, bucket by bucket, of

    position     3 x float32 | 3 x 16 bits, where p stands for a bucket's centre + (p - range) block / (2 range)
    scale        3 x float32 | 3 x float16     standard deviations
    rotation     4 x float32 | 4 x float16     a quaternion w, x, y, z
    colour       3 x 8 bits                    255 (0.5 + DC f) of the coefficient f of degree 0, rounded down
    opacity      1 x 8 bits                    255 sigmoid(logit), rounded down
    harmonics    3K x float32 | float16 | 8 bits between the ends of the header's range

at compression level 0 | 1 and 2, harmonics at level 0 | 1 | 2. These are of degree 2 at most; degree 1 comes first, and
in each degree all of red before all of green before all of blue. The axes are the same as in PLY files.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from nerfloom.base.errors import DataError
from nerfloom.kernels.splats.project import DEGREES
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.ply import usable
from nerfloom.splats.stored import as_float32, colors_of_bytes, log_scales_of, logits_of_bytes

HEADER = np.dtype({
    "names": ["major", "minor", "sections", "gaussians", "level", "low", "high"],
    "formats": ["u1", "u1", "<u4", "<u4", "<u2", "<f4", "<f4"],
    "offsets": [0, 1, 4, 16, 20, 36, 40],
    "itemsize": 4096,
})  # fmt: skip
"""The start of a file."""
SECTION = np.dtype({
    "names": ["count", "room", "bucket_size", "buckets", "block", "center_bytes", "steps", "full", "partial", "degree"],
    "formats": ["<u4", "<u4", "<u4", "<u4", "<f4", "<u2", "<u4", "<u4", "<u4", "<u2"],
    "offsets": [0, 4, 8, 12, 16, 20, 24, 32, 36, 40],
    "itemsize": 1024,
})  # fmt: skip
"""The header of a section."""
MAX_DEGREE = 2
"""Highest degree of the harmonics."""
HALF_RANGE = 1.5
"""Harmonics of 8 bits are between minus and plus this if the header states no range."""
STEPS = 32767
"""Steps of a position on each side of a bucket's centre if the header states none."""
CENTER_BYTES = 12
"""Size of a bucket's centre."""


class _Header(NamedTuple):
    major: int
    minor: int
    sections: int
    gaussians: int
    level: int
    low: float
    high: float


class _Section(NamedTuple):
    gaussians: int
    room: int
    bucket_size: int
    buckets: int
    block: float
    center_bytes: int
    steps: int
    full: int
    partial: int
    degree: int


def read_ksplat(file: Path) -> Gaussians:
    """Read Gaussians from a KSPLAT file.

    Gaussians that are not finite are removed, with a message on the terminal. Opacities of 0 and 1 become 1/1020 and
    1019/1020, because their logits must be finite.

    Args:
        file: path of the file.

    Raises:
        DataError: if the file cannot be read, is of another version, is truncated or damaged.
    """
    try:
        content = file.read_bytes()
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror}") from error
    header = _header(file, content)
    table = np.frombuffer(content, SECTION, header.sections, HEADER.itemsize)
    start, parts = HEADER.itemsize + SECTION.itemsize * header.sections, list[Gaussians]()
    for values in table:
        section = _Section(*values.item())
        row = _row(file, header.level, section.degree)
        rows = start + 4 * section.partial + section.center_bytes * section.buckets
        end = rows + section.room * row.itemsize
        if end > len(content) or section.gaussians > section.room:
            raise DataError(
                f"{file} is truncated: a section states {section.room:,} Gaussians, and the file has {len(content):,}"
                " bytes; copy or export it again"
            )
        if section.gaussians:
            stored = np.frombuffer(content, row, section.gaussians, rows)
            means = _means(file, header.level, section, content[start:rows], stored["center"])
            parts.append(_gaussians(header, stored, means))
        start = end
    if sum(map(len, parts)) != header.gaussians or not parts:
        raise DataError(
            f"{file} is damaged: it states {header.gaussians:,} Gaussians, and its sections have"
            f" {sum(map(len, parts)):,}; export it again"
        )
    return usable(_together(parts), file)


def _header(file: Path, content: bytes) -> _Header:
    if len(content) < HEADER.itemsize:
        raise DataError(f"{file} is no KSPLAT file, or is truncated: it has {len(content):,} bytes; export it again")
    header = _Header(*np.frombuffer(content, HEADER, 1)[0].item())
    if (header.major, header.minor) != (0, 1):
        raise DataError(
            f"{file} is KSPLAT of version {header.major}.{header.minor}, or something else; version 0.1 can be read:"
            " convert it to PLY"
        )
    if header.level > 2 or HEADER.itemsize + SECTION.itemsize * header.sections > len(content):
        raise DataError(
            f"{file} is damaged: its header states {header.sections:,} sections of compression level {header.level};"
            " export it again"
        )
    return header


def _row(file: Path, level: int, degree: int) -> np.dtype:
    """Return the type of a Gaussian."""
    if degree > MAX_DEGREE:
        raise DataError(f"{file} is damaged: a section states harmonics of degree {degree}; export it again")
    number = "<f4" if level == 0 else "<f2"
    return np.dtype([
        ("center", "<f4" if level == 0 else "<u2", 3),
        ("scale", number, 3),
        ("rotation", number, 4),
        ("color", "u1", 4),
        ("harmonics", ("<f4", "<f2", "u1")[level], (3 * DEGREES[degree],)),
    ])  # fmt: skip


def _means(file: Path, level: int, section: _Section, buckets: bytes, stored: np.ndarray) -> np.ndarray:
    """Return positions (N, 3), float64.

    Args:
        file: path of the file, for messages.
        level: compression level.
        section: header of the section.
        buckets: its lengths of buckets, and their centres.
        stored: (N, 3) positions as they are stored.

    Raises:
        DataError: if the buckets do not fit the Gaussians.
    """
    if level == 0:
        return stored.astype(np.float64)
    lengths = np.frombuffer(buckets[: 4 * section.partial], "<u4")
    if section.full + section.partial > section.buckets or section.center_bytes != CENTER_BYTES:
        raise DataError(
            f"{file} is damaged: a section states {section.buckets:,} buckets of {section.center_bytes} bytes, and"
            f" {section.full:,} and {section.partial:,} of them; export it again"
        )
    ends = np.cumsum(np.concatenate([np.full(section.full, section.bucket_size), lengths]), dtype=np.int64)
    bucket = np.searchsorted(ends, np.arange(len(stored)), side="right")
    if int(bucket[-1]) >= len(ends):
        raise DataError(f"{file} is damaged: the buckets of a section hold too few Gaussians; export it again")
    centers = np.frombuffer(buckets[4 * section.partial :], "<f4").reshape(-1, 3)
    steps = section.steps or STEPS
    with np.errstate(over="ignore", invalid="ignore"):  # values that are not finite are removed later
        return (stored.astype(np.float64) - steps) * (section.block / 2 / steps) + centers[bucket].astype(np.float64)


def _gaussians(header: _Header, rows: np.ndarray, means: np.ndarray) -> Gaussians:
    return Gaussians(
        means=as_float32(means),
        log_scales=log_scales_of(rows["scale"]),
        rotations=as_float32(rows["rotation"]),
        logits=logits_of_bytes(rows["color"][:, 3]),
        colors=colors_of_bytes(rows["color"][:, :3]),
        harmonics=_harmonics(header, rows["harmonics"]),
    )


def _harmonics(header: _Header, stored: np.ndarray) -> Tensor:
    """Return harmonics (N, 3, K): in the file, each degree has all of red before all of green before all of blue."""
    values = stored.astype(np.float64)
    if header.level == 2:
        low, high = header.low or -HALF_RANGE, header.high or HALF_RANGE
        with np.errstate(invalid="ignore"):  # values that are not finite are removed later
            values = low + values / 255 * (high - low)
    bands = [values[:, :9], values[:, 9:]]
    return torch.cat([as_float32(band).reshape(len(values), 3, band.shape[1] // 3) for band in bands], -1)


def _together(parts: list[Gaussians]) -> Gaussians:
    """Return all Gaussians; Gaussians of lower degrees get harmonics of 0."""
    terms = max(part.harmonics.shape[2] for part in parts)
    return Gaussians.joined([
        replace(part, harmonics=pad(part.harmonics, (0, terms - part.harmonics.shape[2]))) for part in parts
    ])  # fmt: skip
