"""Gaussians in SPZ files (Niantic): 8 to 24 bits a number, compressed by gzip; about a tenth of a PLY file.

The format is described in https://github.com/nianticlabs/spz (README.md and src/cc/load-spz.cc). A header of 16 bytes
(magic NGSP, version, number of Gaussians, degree, fractional bits, flags) is followed by one array an attribute:

    positions    3 x 24 bits    fixed point, with the header's number of fractional bits
    opacities    1 x 8 bits     255 sigmoid(logit)
    colours      3 x 8 bits     255 (0.15 f + 0.5) of the coefficient f of degree 0
    scales       3 x 8 bits     16 (log + 10)
    rotations    3 x 8 bits     version 2: 127.5 (q + 1) of x, y and z of a unit quaternion with w >= 0
                 32 bits        version 3: which of x, y, z, w is largest, and the others in 10 bits each
    harmonics    3K x 8 bits    128 (f + 1) of degrees 1 and higher; red, green, blue of each coefficient in a row

**Axes.** The README says that SPZ is RUB (x right, y up, z back) and PLY is RDF (x right, y down, z front). The axes of
a captured scene are arbitrary; what matters is that y and z change sign between the two formats. `read_spz` returns the
values of a PLY file of the same scene, equal to those of Niantic's library in RDF. (Some converters do not change the
axes.) The sign also changes for y and z of quaternions and for harmonics that are odd in y and z together (`SIGNS`).

**How they are drawn.** The lowest bit of the flags says that the Gaussians were trained with antialiasing. The other
settings of `nerfloom.splats.look` are in the comment of the gzip file (RFC 1952, FCOMMENT), which other programs skip.

**Versions.** Version 2 is written, since some programs read no other; 2 and 3 are read. With 8 bits of x, y and z, w
near 0 is inaccurate, and a rotation may be wrong by twelve degrees. But a Gaussian has 24 equivalent descriptions,
since its axes can be permuted and reversed, and in one of them w is at least 0.85. That one is written; its error is at
most one degree.
"""

from __future__ import annotations

import gzip
import math
import struct
import zlib
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError, DataError
from nerfloom.splats.gaussians import MAX_DEGREE, Gaussians, Splats
from nerfloom.splats.look import ELSEWHERE, OURS, Look, comments, look_of
from nerfloom.splats.ply import usable
from nerfloom.splats.transform import quaternion_product

MAGIC = b"NGSP"
HEADER = struct.Struct("<4sIIBBBB")
"""Magic, version, number of Gaussians, degree, fractional bits, flags, 0."""
MAX_GAUSSIANS = 10_000_000
"""Maximum number of Gaussians, as in Niantic's library."""
BITS = (5, 4)
"""Bits of harmonics of degree 1, and of higher degrees, as in Niantic's library."""
FRACTIONAL_BITS = 12
"""Fractional bits of a position, as in Niantic's library; more for small Gaussians, fewer for large scenes."""
STEPS = 16
"""Minimum number of position steps per standard deviation of a typical Gaussian, if the range allows it."""
SIGNS = (-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1)
"""Factors of harmonics of degrees 1 to 3 when y and z change sign."""
MAX_RATIO = 1032
"""Maximum ratio of sizes before and after compression by gzip."""
FLAT = 3.0
"""Logarithm of the ratio of the largest to the smallest size that is not reported as clipped; smaller sizes are
invisible."""
ANTIALIASED = 1
"""Bit of the header's flags."""
FCOMMENT, COMMENT_START, MAX_COMMENT_LENGTH = 16, 10, 1000
"""In the gzip header: the flags with only a comment, the offset of the comment, and its maximum length, bytes."""
MAX_SURPLUS = 1 << 24
"""Maximum number of bytes after the last array, for extensions of the format."""


def encoded(gaussians: Gaussians, bits: tuple[int, int] = BITS, look: Look = OURS) -> bytes:
    """Return the content of an SPZ file of version 2.

    What exceeds the format's range is clipped: standard deviations to e^-10 ... e^5.9, coefficients of degree 0 to
    +-3.3 and others to -1 ... 0.99. Elsewhere the error is at most half a step: 1/32 of a logarithm of a scale, 1/510
    of an opacity, 1/76 of a coefficient of degree 0, 2^-bits of a harmonic.

    Args:
        gaussians: N finite Gaussians on the CPU.
        bits: number of bits of harmonics of degree 1 and of higher degrees, at most 8. Fewer compress better.
        look: the settings of drawing.

    Raises:
        ConfigError: if the format cannot hold them.
    """
    if len(gaussians) > MAX_GAUSSIANS:
        raise ConfigError(f"an SPZ file holds {MAX_GAUSSIANS:,} Gaussians, not {len(gaussians):,}: write a PLY file")
    fraction = fractional_bits(gaussians)
    fixed = np.rint(gaussians.means.double().numpy() * np.array([1, -1, -1]) * 2.0**fraction).astype("<i4")
    rotations, log_scales = _largest_real_part(gaussians.rotations, gaussians.log_scales)
    vectors = rotations[:, 1:].numpy() * np.array([1, -1, -1])
    terms = gaussians.harmonics.shape[2]
    signed = gaussians.harmonics.numpy() * np.array(SIGNS[:terms], np.float32)
    arrays = [
        fixed.view("u1").reshape(-1, 3, 4)[:, :, :3],
        _bytes(255 * gaussians.logits.double().sigmoid().numpy()),
        _bytes(255 * (0.15 * gaussians.colors.numpy() + 0.5)),
        _bytes(16 * (log_scales.numpy() + 10)),
        _bytes(127.5 * (vectors + 1)),
        _rounded(signed, bits).transpose(0, 2, 1),
    ]
    flags = ANTIALIASED if look.antialiased else 0
    header = HEADER.pack(MAGIC, 2, len(gaussians), gaussians.degree, fraction, flags, 0)
    content = b"".join([header, *(np.ascontiguousarray(array).tobytes() for array in arrays)])
    return _commented(gzip.compress(content, 6, mtime=0), "\n".join(comments(look)))


def _commented(packed: bytes, comment: str) -> bytes:
    """Return a gzip file with a comment."""
    start = packed[:3] + bytes([FCOMMENT]) + packed[4:COMMENT_START]
    return start + comment.encode("latin-1") + b"\0" + packed[COMMENT_START:]


def _comment(packed: bytes) -> list[str]:
    """Return the lines of the comment at the start of a gzip file; none if its header has other parts."""
    text, end, _ = packed[COMMENT_START : COMMENT_START + MAX_COMMENT_LENGTH].partition(b"\0")
    return text.decode("latin-1").splitlines() if end and packed[3] == FCOMMENT else []


def fractional_bits(gaussians: Gaussians) -> int:
    """Return the number of fractional bits for positions.

    Args:
        gaussians: N finite Gaussians.

    Raises:
        ConfigError: if a position is out of range even with 0 fractional bits.
    """
    if not len(gaussians):
        return FRACTIONAL_BITS
    furthest = max(float(gaussians.means.abs().max()), 1e-30)
    most = math.floor(math.log2((2**23 - 1) / furthest))
    if most < 0:
        raise ConfigError(
            f"an SPZ file holds positions up to {2**23 - 1:,}, and a Gaussian is at {furthest:,.0f}: write a PLY file"
        )
    typical = float(gaussians.log_scales.median())
    return max(0, min(most, max(FRACTIONAL_BITS, math.ceil(math.log2(STEPS) - typical / math.log(2))), 30))


def out_of_range(gaussians: Gaussians) -> list[str]:
    """Return sentences about losses from the format's range, beyond its usual rounding.

    Args:
        gaussians: N finite Gaussians.
    """
    lost = []
    step = 2.0 ** -fractional_bits(gaussians)
    typical = math.exp(float(gaussians.log_scales.median())) if len(gaussians) else math.inf
    if step > 2 * typical / STEPS:
        lost.append(
            f"SPZ rounds positions to {step:.2g}, and a typical Gaussian has the size {typical:.2g}; PLY does not"
        )
    largest = gaussians.log_scales.amax(-1, keepdim=True)
    seen = (gaussians.log_scales < -10) & (largest < -10 + FLAT)
    outside = (seen | (largest > 6)).any(-1)
    if count := int(outside.sum()):
        sizes = f"{math.exp(-10):.2g} to {math.exp(6):.0f}"
        lost.append(f"SPZ holds sizes from {sizes}: {count:,} of the Gaussians get the nearest of these")
    return lost


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.rint(values).clip(0, 255).astype(np.uint8)


def _rounded(harmonics: np.ndarray, bits: tuple[int, int]) -> np.ndarray:
    """Return bytes (N, 3, K), rounded to multiples of the step; 256 becomes 255."""
    steps = np.array([2 ** (8 - bits[0])] * 3 + [2 ** (8 - bits[1])] * 12, np.float32)[: harmonics.shape[2]]
    return _bytes(np.rint(128 * (harmonics + 1) / steps) * steps)


def rounded_harmonics(harmonics: Tensor, bits: tuple[int, int]) -> Tensor:
    """Return harmonics as they are read back, in their original axes.

    Args:
        harmonics: (N, 3, K) on the CPU.
        bits: as in `encoded`.
    """
    signs = np.array(SIGNS[: harmonics.shape[2]], np.float32)
    return _float((_rounded(harmonics.numpy() * signs, bits) / 128.0 - 1) * signs)


def _group() -> Tensor:
    """Return the 24 rotations of a cube as unit quaternions (24, 4), float64, one of each pair of opposite ones."""
    candidates = torch.tensor(list(product((-1.0, 0.0, 1.0), repeat=4)), dtype=torch.float64)
    counts = (candidates != 0).sum(-1)
    candidates = candidates[(counts == 1) | (counts == 2) | (counts == 4)]
    first = torch.tensor([next(value for value in row if value) for row in candidates.tolist()])
    chosen = candidates[first > 0]
    return chosen / chosen.norm(dim=-1, keepdim=True)


def _largest_real_part(rotations: Tensor, log_scales: Tensor) -> tuple[Tensor, Tensor]:
    """Return unit quaternions (N, 4), float64, with the largest w among those of the same Gaussians, and log scales."""
    unit = rotations.double()
    unit = unit / unit.norm(dim=-1, keepdim=True).clamp(min=1e-300)
    group = _group()
    conjugate = group * torch.tensor([1.0, -1, -1, -1]).double()
    # w of the product with g is the scalar product with the conjugate of g.
    best = torch.cat([(part @ conjugate.T).abs().argmax(-1) for part in unit.split(1 << 18)])
    turned = quaternion_product(unit, group[best])
    turned = torch.where(turned[:, :1] < 0, -turned, turned)
    # The new axis j is the old axis that g rotates it to, up to sign.
    units = torch.cat([torch.zeros(3, 1), torch.eye(3)], dim=-1).double()
    images = quaternion_product(quaternion_product(group[:, None], units), conjugate[:, None])[..., 1:]
    return turned, log_scales.gather(1, images.abs().argmax(-1)[best])


def read_spz(file: Path) -> Splats:
    """Read Gaussians from an SPZ file of version 2 or 3, in the axes of PLY files.

    Opacities of 0 and 1 become 1/1020 and 1019/1020, the centres of the intervals that round to them; their own logits
    are infinite. Degree 4 and extensions are dropped.

    Args:
        file: path of the file.

    Raises:
        DataError: if the file cannot be read, is not an SPZ file of these versions, is truncated or damaged.
    """
    version, count, degree, fraction, flags, raw = _unpacked(file)
    terms = (degree + 1) ** 2 - 1
    sizes = _sizes(version, terms)
    cuts = np.cumsum([0, *(size * count for size in sizes)])
    positions, alphas, colors, scales, rotations, harmonics = (
        raw[start:end].reshape(count, size) for start, end, size in zip(cuts[:-1], cuts[1:], sizes, strict=True)
    )
    low = positions.reshape(count, 3, 3).astype(np.int32)
    fixed = low[:, :, 0] | low[:, :, 1] << 8 | low[:, :, 2] << 16
    fixed = (fixed ^ 0x800000) - 0x800000
    flip = np.array([1, -1, -1])
    quaternions = (_first_three if version == 2 else _smallest_three)(rotations)
    quaternions[:, 2:] *= -1
    opacity = alphas[:, 0].astype(np.float64).clip(0.25, 254.75) / 255
    wanted = min(terms, (MAX_DEGREE + 1) ** 2 - 1)
    if wanted < terms:
        say(f"{file}: harmonics above degree {MAX_DEGREE} are left out")
    values = harmonics.reshape(count, terms, 3)[:, :wanted].transpose(0, 2, 1).astype(np.float32) / 128 - 1
    gaussians = Gaussians(
        means=_float(fixed * flip * 2.0**-fraction),
        log_scales=_float(scales / 16.0 - 10),
        rotations=_float(quaternions),
        logits=_float(np.log(opacity / (1 - opacity))),
        colors=_float((colors / 255.0 - 0.5) / 0.15),
        harmonics=_float(values * np.array(SIGNS[:wanted], np.float32)),
    )
    return Splats(usable(gaussians, file), _look(file, flags))


def _look(file: Path, flags: int) -> Look:
    """Return the settings of drawing from the flags and the comment."""
    with file.open("rb") as stream:
        lines = _comment(stream.read(COMMENT_START + MAX_COMMENT_LENGTH))
    return replace(look_of(lines, file, ELSEWHERE), antialiased=bool(flags & ANTIALIASED))


def _float(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, np.float32))


def _sizes(version: int, terms: int) -> tuple[int, ...]:
    """Return the number of bytes per Gaussian in each array."""
    return 9, 1, 3, 3, 3 if version == 2 else 4, 3 * terms


def _unpacked(file: Path) -> tuple[int, int, int, int, int, np.ndarray]:
    """Return version, number of Gaussians, degree, fractional bits, flags, and the bytes behind the header."""
    try:
        with file.open("rb") as plain:
            if plain.read(4) == MAGIC:
                raise DataError(f"{file} is SPZ of version 4 or later: convert it to version 3, or to a PLY file")
        with gzip.open(file, "rb") as stream:
            start = stream.read(HEADER.size)
            version, count, degree, fraction, flags = _checked_header(file, start)
            needed = count * sum(_sizes(version, (degree + 1) ** 2 - 1))
            size = file.stat().st_size
            if needed > MAX_RATIO * size:
                raise DataError(f"{file} is truncated: {count:,} Gaussians have more than its {size:,} bytes")
            content = stream.read(needed)
            if len(content) < needed:
                raise DataError(f"{file} is truncated: its header states {count:,} Gaussians; copy or export it again")
            surplus = 0
            while more := stream.read(1 << 16):  # to its end, where the checksum is
                surplus += len(more)
                if surplus > MAX_SURPLUS:
                    raise DataError(f"{file} has too much behind its {count:,} Gaussians; export it again")
    except (gzip.BadGzipFile, zlib.error) as error:
        raise DataError(f"{file} is damaged, or not an SPZ file: copy or export it again") from error
    except EOFError as error:
        raise DataError(f"{file} is truncated: copy or export it again") from error
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror}") from error
    return version, count, degree, fraction, flags, np.frombuffer(content, np.uint8)


def _checked_header(file: Path, start: bytes) -> tuple[int, int, int, int, int]:
    if start[:4] != MAGIC:
        raise DataError(f"{file} is not an SPZ file: what it unpacks to does not begin with {MAGIC.decode()}")
    if len(start) < HEADER.size:
        raise DataError(f"{file} is truncated: copy or export it again")
    _, version, count, degree, fraction, flags, _ = HEADER.unpack(start)
    if version not in (2, 3):
        raise DataError(f"{file} is SPZ of version {version}; versions 2 and 3 can be read: convert it")
    if degree > 4 or fraction > 30 or count > MAX_GAUSSIANS:
        raise DataError(
            f"{file} is damaged: its header states {count:,} Gaussians of degree {degree} with {fraction} fractional"
            f" bits, and the format has up to {MAX_GAUSSIANS:,}, 4 and 30; export it again"
        )
    return version, count, degree, fraction, flags


def _first_three(stored: np.ndarray) -> np.ndarray:
    """Return quaternions (N, 4) w, x, y, z of version 2's bytes (N, 3)."""
    vectors = stored / 127.5 - 1
    real = np.sqrt((1 - (vectors**2).sum(-1)).clip(0))
    return np.concatenate([real[:, None], vectors], axis=-1)


def _smallest_three(stored: np.ndarray) -> np.ndarray:
    """Return quaternions (N, 4) w, x, y, z of version 3's bytes (N, 4).

    From the highest bit: the place of the largest component among x, y, z, w in 2 bits, then the others in their order,
    each as a sign and 9 bits of its magnitude times sqrt(2).
    """
    words = np.ascontiguousarray(stored).view("<u4")[:, 0]
    fields = np.stack([words >> 20 & 1023, words >> 10 & 1023, words & 1023], axis=-1).astype(np.int64)
    others = (fields & 511) / 511 * math.sqrt(0.5) * np.where(fields & 512, -1, 1)
    largest = np.sqrt((1 - (others**2).sum(-1)).clip(0))
    result = np.empty((len(words), 4))
    for place in range(4):
        rows = words >> 30 == place
        columns = [(component + 1) % 4 for component in range(4) if component != place]  # of x, y, z, w in w, x, y, z
        result[np.ix_(rows, columns)] = others[rows]
        result[rows, (place + 1) % 4] = largest[rows]
    return result
