"""Gaussians in SPZ files (Niantic): 8 to 24 bits a number, compressed; about a tenth of a PLY file.

The format is described in https://github.com/nianticlabs/spz (README.md and src/cc/load-spz.cc). Its containers are in
`nerfloom.splats.spz_container`. There is one array an attribute:

    positions    3 x 24 bits    fixed point, with the header's number of fractional bits; version 1: 3 x float16
    opacities    1 x 8 bits     255 sigmoid(logit)
    colours      3 x 8 bits     255 (0.15 f + 0.5) of the coefficient f of degree 0
    scales       3 x 8 bits     16 (log + 10)
    rotations    3 x 8 bits     versions 1 and 2: 127.5 (q + 1) of x, y and z of a unit quaternion with w >= 0
                 32 bits        versions 3 and 4: which of x, y, z, w is largest, and the others in 10 bits each
    harmonics    3K x 8 bits    128 (f + 1) of degrees 1 and higher; red, green, blue of each coefficient in a row

**Axes.** The README says that SPZ is RUB (x right, y up, z back) and PLY is RDF (x right, y down, z front). The axes of
a captured scene are arbitrary, but y and z must change sign between the two formats. `read_spz` returns the values of a
PLY file of the same scene, as Niantic's library does in RDF. (Some converters do not change the
axes.) The sign also changes for y and z of quaternions and for harmonics that are odd in y and z together (`SIGNS`).

**How they are drawn.** The lowest bit of the flags says that the Gaussians were trained with antialiasing. The other
settings of `nerfloom.splats.look` are in a place that other programs skip.

**Versions.** Version 2 is written unless another is asked for, since some programs read no other. With 8 bits of x, y
and z, w near 0 is inaccurate, and a rotation may be wrong by twelve degrees. But a Gaussian has 24 equivalent
descriptions, since its axes can be permuted and reversed, and in one of them w is at least 0.85. This one is written;
its error is at most one degree. In versions 3 and 4 it is at most 0.3 degrees.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.console import say
from nerfloom.base.errors import ConfigError
from nerfloom.splats.gaussians import MAX_DEGREE, Gaussians, Splats
from nerfloom.splats.look import ELSEWHERE, OURS, Look, comments, look_of
from nerfloom.splats.ply import usable
from nerfloom.splats.smallest_three import joined, split
from nerfloom.splats.spz_container import MAX_GAUSSIANS, Packed, SpzVersion, packed_bytes, read_packed
from nerfloom.splats.stored import as_float32, logits_of_bytes
from nerfloom.splats.transform import quaternion_product

BITS = (5, 4)
"""Bits of harmonics of degree 1, and of higher degrees, as in Niantic's library."""
FRACTIONAL_BITS = 12
"""Fractional bits of a position, as in Niantic's library; more for small Gaussians, fewer for large scenes."""
STEPS = 16
"""Minimum number of position steps per standard deviation of a typical Gaussian, if the range allows it."""
FLIP = np.array([1, -1, -1])
"""Factors of x, y and z between the axes of SPZ and of PLY."""
SIGNS = (-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1)
"""Factors of harmonics of degrees 1 to 3 when y and z change sign."""
FLAT = 3.0
"""Logarithm of the ratio of the largest to the smallest size that is not reported as clipped; smaller sizes are
invisible."""
MAX_LOG_SCALE = 255 / 16 - 10
"""Maximum logarithm of a scale."""
MAX_COLOR, MAX_HARMONIC = 0.5 / 0.15, 1.0
"""Maximum magnitudes of coefficients of degree 0, and of higher degrees; the latter lacks one step at the upper end."""
ANTIALIASED = 1
"""Bit of the header's flags."""


def encoded(gaussians: Gaussians, bits: tuple[int, int] = BITS, look: Look = OURS, version: SpzVersion = 2) -> bytes:
    """Return the content of an SPZ file.

    Values outside the format's range are clipped: standard deviations to e^-10 ... e^5.9, coefficients of degree 0 to
    +-3.3 and others to -1 ... 0.99. Elsewhere the error is at most half a step: 1/32 of a logarithm of a scale, 1/510
    of an opacity, 1/76 of a coefficient of degree 0, 2^-bits of a harmonic.

    Args:
        gaussians: N finite Gaussians on the CPU.
        bits: number of bits of harmonics of degree 1 and of higher degrees, at most 8. Fewer compress better.
        version: version of the format.

    Raises:
        ConfigError: if the format cannot hold them, or version 4 needs a package that is missing.
    """
    if version < 4 and len(gaussians) > MAX_GAUSSIANS:
        raise ConfigError(
            f"an SPZ file of version {version} holds {MAX_GAUSSIANS:,} Gaussians, not {len(gaussians):,}: write a PLY"
            " file, or --spz-version 4"
        )
    fraction = fractional_bits(gaussians)
    fixed = np.rint(gaussians.means.double().numpy() * FLIP * 2.0**fraction).astype("<i4")
    rotations, log_scales = (_with_first_three if version == 2 else _with_smallest_three)(gaussians)
    terms = gaussians.harmonics.shape[2]
    signed = gaussians.harmonics.numpy() * np.array(SIGNS[:terms], np.float32)
    arrays = [
        fixed.view("u1").reshape(-1, 3, 4)[:, :, :3],
        _bytes(255 * gaussians.logits.double().sigmoid().numpy()),
        _bytes(255 * (0.15 * gaussians.colors.numpy() + 0.5)),
        _bytes(16 * (log_scales.numpy() + 10)),
        rotations,
        _rounded(signed, bits).transpose(0, 2, 1),
    ]
    flags = ANTIALIASED if look.antialiased else 0
    # Some programs warn of an extension, so version 4 has one only if there is something to say in it.
    silent = version == 4 and look == replace(ELSEWHERE, antialiased=look.antialiased)
    lines = [] if silent else comments(look)
    return packed_bytes(Packed(version, len(gaussians), gaussians.degree, fraction, flags, arrays, lines))


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
    outside = (seen | (largest > MAX_LOG_SCALE + 1 / 32)).any(-1)
    if count := int(outside.sum()):
        sizes = f"{math.exp(-10):.2g} to {math.exp(MAX_LOG_SCALE):.0f}"
        lost.append(f"SPZ holds sizes from {sizes}: {count:,} of the Gaussians get the nearest of these")
    strong = (gaussians.colors.abs() > MAX_COLOR).any(-1)
    strong |= (gaussians.harmonics.abs() > MAX_HARMONIC).flatten(1).any(-1)
    if count := int(strong.sum()):
        lost.append(
            f"SPZ holds coefficients of degree 0 up to {MAX_COLOR:.2g}, and others up to {MAX_HARMONIC:g}: {count:,} of"
            " the Gaussians get the nearest of these"
        )
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
    return as_float32((_rounded(harmonics.numpy() * signs, bits) / 128.0 - 1) * signs)


def _group() -> Tensor:
    """Return the 24 rotations of a cube as unit quaternions (24, 4), float64, one of each pair of opposite ones."""
    candidates = torch.tensor(list(product((-1.0, 0.0, 1.0), repeat=4)), dtype=torch.float64)
    counts = (candidates != 0).sum(-1)
    candidates = candidates[(counts == 1) | (counts == 2) | (counts == 4)]
    first = torch.tensor([next(value for value in row if value) for row in candidates.tolist()])
    chosen = candidates[first > 0]
    return chosen / chosen.norm(dim=-1, keepdim=True)


def _largest_real_part(rotations: Tensor, log_scales: Tensor) -> tuple[Tensor, Tensor]:
    """Return unit quaternions (N, 4), float64, with the largest w among equivalent descriptions, and log scales."""
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


def _with_first_three(gaussians: Gaussians) -> tuple[np.ndarray, Tensor]:
    """Return rotations as version 2's bytes (N, 3), and the logarithms of the scales along their axes."""
    rotations, log_scales = _largest_real_part(gaussians.rotations, gaussians.log_scales)
    return _bytes(127.5 * (rotations[:, 1:].numpy() * FLIP + 1)), log_scales


def _with_smallest_three(gaussians: Gaussians) -> tuple[np.ndarray, Tensor]:
    """Return rotations as the bytes (N, 4) of versions 3 and 4, and the logarithms of the scales along their axes.

    Layout from the highest bit: the place of the largest component among x, y, z, w in 2 bits, then the others in their
    order, each as a sign and 9 bits of its magnitude times sqrt(2).
    """
    rotations = gaussians.rotations.double().numpy()
    place, others = split(np.concatenate([rotations[:, 1:] * FLIP, rotations[:, :1]], -1))
    words = place.astype(np.int64)
    for component in others.T:
        magnitude = np.rint(511 * math.sqrt(2) * np.abs(component)).astype(np.int64).clip(0, 511)
        words = words << 10 | (component < 0).astype(np.int64) << 9 | magnitude
    return words.astype("<u4")[:, None].view("u1"), gaussians.log_scales


def read_spz(file: Path) -> Splats:
    """Read Gaussians from an SPZ file of version 1 to 4, in the axes of PLY files.

    Opacities of 0 and 1 become 1/1020 and 1019/1020, the centres of the intervals that round to them; their own logits
    are infinite. Degree 4 is dropped.

    Args:
        file: path of the file.

    Raises:
        DataError: if the file cannot be read, is not an SPZ file of these versions, is truncated or damaged.
        ConfigError: if version 4 needs a package that is missing.
    """
    packed = read_packed(file)
    positions, alphas, colors, scales, rotations, harmonics = packed.arrays
    quaternions = (_first_three if packed.version < 3 else _smallest_three)(rotations)
    quaternions[:, 2:] *= -1
    terms = harmonics.shape[1] // 3
    wanted = min(terms, (MAX_DEGREE + 1) ** 2 - 1)
    if wanted < terms:
        say(f"{file}: harmonics above degree {MAX_DEGREE} are left out")
    values = harmonics.reshape(packed.count, terms, 3)[:, :wanted].transpose(0, 2, 1).astype(np.float32) / 128 - 1
    gaussians = Gaussians(
        means=as_float32(_positions(positions, packed) * FLIP),
        log_scales=as_float32(scales / 16.0 - 10),
        rotations=as_float32(quaternions),
        logits=logits_of_bytes(alphas[:, 0]),
        colors=as_float32((colors / 255.0 - 0.5) / 0.15),
        harmonics=as_float32(values * np.array(SIGNS[:wanted], np.float32)),
    )
    look = look_of(packed.comments, file, ELSEWHERE)
    return Splats(usable(gaussians, file), replace(look, antialiased=bool(packed.flags & ANTIALIASED)))


def _positions(stored: np.ndarray, packed: Packed) -> np.ndarray:
    """Return positions (N, 3), float64, in the axes of the file."""
    if packed.version == 1:
        return np.ascontiguousarray(stored).view("<f2").astype(np.float64)
    parts = stored.reshape(packed.count, 3, 3).astype(np.int32)
    fixed = parts[:, :, 0] | parts[:, :, 1] << 8 | parts[:, :, 2] << 16
    return ((fixed ^ 0x800000) - 0x800000) * 2.0**-packed.fraction


def _first_three(stored: np.ndarray) -> np.ndarray:
    """Return quaternions (N, 4) w, x, y, z of version 2's bytes (N, 3)."""
    vectors = stored / 127.5 - 1
    real = np.sqrt((1 - (vectors**2).sum(-1)).clip(0))
    return np.concatenate([real[:, None], vectors], axis=-1)


def _smallest_three(stored: np.ndarray) -> np.ndarray:
    """Return quaternions (N, 4) w, x, y, z of the bytes (N, 4) of versions 3 and 4 (`_with_smallest_three`)."""
    words = np.ascontiguousarray(stored).view("<u4")[:, 0]
    fields = np.stack([words >> 20 & 1023, words >> 10 & 1023, words & 1023], axis=-1).astype(np.int64)
    others = (fields & 511) / 511 * math.sqrt(0.5) * np.where(fields & 512, -1, 1)
    return np.roll(joined(words >> 30, others), 1, axis=-1)  # of x, y, z, w in w, x, y, z
