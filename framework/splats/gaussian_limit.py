"""Gaussians in files of limited size.

Harmonics are reduced first: their degree and, in SPZ files, their number of bits. Among the choices that fit, the one
with the least error is used. Gaussians are dropped, the least visible first, only if degree 0 is too large.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import OURS, Look
from nerfloom.splats.ply import ply_size
from nerfloom.splats.spz import BITS, encoded, out_of_range, rounded_harmonics
from nerfloom.splats.spz_container import SpzVersion

COARSER_BITS = (4, 3)
"""Bits of harmonics in SPZ files if `BITS` are too many."""
MAX_SAMPLE = 1 << 16
"""Maximum number of Gaussians used to estimate sizes and errors."""
DOUBT = 1.05
"""A choice is not tried if its estimated size exceeds the limit by more than this ratio."""

Encode = Callable[[Gaussians], tuple[bytes, list[str]]]
"""Returns the content of a file of Gaussians, and sentences about its losses."""


def fitted_ply(gaussians: Gaussians, most_bytes: float, look: Look = OURS) -> tuple[Gaussians, str]:
    """Return Gaussians that fit into a PLY file of limited size, and a description of the removed parts.

    Args:
        gaussians: N Gaussians.
        most_bytes: maximum size of the file.

    Raises:
        ConfigError: if not even one Gaussian fits.
    """
    for degree in range(gaussians.degree, -1, -1):
        if ply_size(len(gaussians), _terms(degree), look) <= most_bytes:
            return with_degree(gaussians, degree), _changes(gaussians, degree, BITS, len(gaussians))
    # An upper bound of the number that fits: the header is longest for N.
    header = ply_size(len(gaussians), 0, look) - len(gaussians) * (row := ply_size(1, 0) - ply_size(0, 0))
    count = math.floor((most_bytes - header) / row)
    if count < 1:
        raise _too_small(most_bytes)
    return most_visible(with_degree(gaussians, 0), count), _changes(gaussians, 0, BITS, count)


def fitted_spz(
    gaussians: Gaussians, most_bytes: float | None, look: Look = OURS, version: SpzVersion = 2
) -> tuple[bytes, list[str], str]:
    """Return an SPZ file of limited size, as `fitted` does for other formats.

    Args:
        gaussians: N Gaussians on the CPU.
        most_bytes: maximum size of the file; None for any.
        version: version of the format.

    Returns:
        The content, sentences about losses, and a description of the removed parts.

    Raises:
        ConfigError: if not even one Gaussian fits, or the format cannot hold them.
    """
    if most_bytes is None:
        return encoded(gaussians, BITS, look, version), out_of_range(gaussians), ""
    sample = gaussians[:: -(-len(gaussians) // MAX_SAMPLE) or 1]
    choices = [(degree, bits) for degree in range(1, gaussians.degree + 1) for bits in (BITS, COARSER_BITS)]
    choices = [(0, BITS), *choices]
    for degree, bits in sorted(choices, key=lambda choice: colour_error(sample, *choice)):
        size = len(encoded(with_degree(sample, degree), bits, version=version)) * len(gaussians) / max(len(sample), 1)
        if size > DOUBT * most_bytes:
            continue
        kept = with_degree(gaussians, degree)
        content = encoded(kept, bits, look, version)
        if len(content) <= most_bytes:
            return content, out_of_range(kept), _changes(gaussians, degree, bits, len(gaussians))
    return _fewer(gaussians, most_bytes, lambda kept: (encoded(kept, BITS, look, version), out_of_range(kept)))


def fitted(gaussians: Gaussians, most_bytes: float | None, encode: Encode) -> tuple[bytes, list[str], str]:
    """Return a file of limited size in a format that has no choice but the degree and the number of Gaussians.

    Args:
        gaussians: N Gaussians on the CPU.
        most_bytes: maximum size of the file; None for any.
        encode: returns the content of a file of given Gaussians, and sentences about losses.

    Returns:
        The content, the sentences, and a description of the removed parts.

    Raises:
        ConfigError: if not even one Gaussian fits, or the format cannot hold them.
    """
    for degree in range(gaussians.degree, -1, -1):
        content, lost = encode(with_degree(gaussians, degree))
        if most_bytes is None or len(content) <= most_bytes:
            return content, lost, _changes(gaussians, degree, BITS, len(gaussians))
    return _fewer(gaussians, most_bytes or 0.0, encode)


def _fewer(gaussians: Gaussians, most_bytes: float, encode: Encode) -> tuple[bytes, list[str], str]:
    """Return a file of as many Gaussians of degree 0 as fit, as `fitted` does."""
    fewer, count = with_degree(gaussians, 0), len(gaussians)
    while count > 0:
        content, lost = encode(most_visible(fewer, count))
        if len(content) <= most_bytes:
            return content, lost, _changes(gaussians, 0, BITS, count)
        count = math.floor(count * min(0.99, 0.995 * most_bytes / len(content)))
    raise _too_small(most_bytes)


def colour_error(gaussians: Gaussians, degree: int, bits: tuple[int, int]) -> float:
    """Return the mean squared error of colours over all directions, weighted by visibility, in an SPZ file.

    Harmonics are orthonormal, so the error is proportional to the sum of squared errors of their coefficients.

    Args:
        gaussians: N Gaussians.
        degree: highest degree that is kept.
        bits: as in `encoded`.
    """
    kept = torch.zeros_like(gaussians.harmonics)
    terms = _terms(degree)
    kept[:, :, :terms] = rounded_harmonics(gaussians.harmonics[:, :, :terms], bits)
    squares = (kept - gaussians.harmonics).double().square().sum((1, 2))
    weights = visibility(gaussians).double()
    return float((weights * squares).sum() / weights.sum().clamp(min=1e-30))


def visibility(gaussians: Gaussians) -> Tensor:
    """Return (N,) opacity times the product of the two largest standard deviations, relative to the largest such value.

    The product is the area of the largest silhouette, up to a factor. A flat Gaussian has no volume and is seen.

    Args:
        gaussians: N Gaussians.
    """
    areas = gaussians.log_scales.sum(-1) - gaussians.log_scales.amin(-1)
    logarithms = torch.nn.functional.logsigmoid(gaussians.logits) + areas
    return (logarithms - logarithms.max()).exp() if len(gaussians) else logarithms


def most_visible(gaussians: Gaussians, count: int) -> Gaussians:
    """Return the most visible Gaussians, in their order.

    Args:
        gaussians: N Gaussians.
        count: number of Gaussians kept, at most N.
    """
    if count >= len(gaussians):
        return gaussians
    return gaussians[visibility(gaussians).argsort(descending=True, stable=True)[:count].sort().values]


def with_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """Return Gaussians with harmonics up to a degree.

    Args:
        gaussians: N Gaussians.
        degree: highest degree that is kept.
    """
    return replace(gaussians, harmonics=gaussians.harmonics[:, :, : _terms(degree)])


def _terms(degree: int) -> int:
    return (degree + 1) ** 2 - 1


def _changes(gaussians: Gaussians, degree: int, bits: tuple[int, int], count: int) -> str:
    parts = []
    if degree < gaussians.degree:
        parts.append(f"harmonics up to degree {degree} of {gaussians.degree}")
    if degree and bits != BITS:
        parts.append(f"{' and '.join(map(str, bits))} bits of harmonics instead of {' and '.join(map(str, BITS))}")
    if count < len(gaussians):
        parts.append(f"the {count:,} most visible of {len(gaussians):,} Gaussians")
    return ", ".join(parts)


def _too_small(most_bytes: float) -> ConfigError:
    return ConfigError(f"no Gaussian fits into {most_bytes:,.0f} bytes; --max-megabytes counts millions of bytes")
