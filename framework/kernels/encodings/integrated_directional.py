"""Integrated directional encoding: Ref-NeRF (Verbin et al. 2022), equations 6 to 8.

The mean of a spherical harmonic of degree l over a von Mises-Fisher distribution is the harmonic at the mean direction
times a factor that depends on the concentration kappa alone. Equation 8 approximates it by exp(-l (l + 1) / (2 kappa)).
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from nerfloom.kernels import native, result_cache
from nerfloom.kernels.dispatch import CPP, TRITON, Operation
from nerfloom.kernels.triton_backend import later

MAX_BANDS = 5
"""Maximum number of bands; the last has degree 16."""
_forward = native.Function("directional_encoding", "ppqipi")
_backward = native.Function("directional_encoding_backward", "ppqipppi")


def degrees(bands: int) -> tuple[int, ...]:
    """Return the degrees 1, 2, 4, ... of the first `bands` bands."""
    return tuple(2**band for band in range(bands))


def num_features(bands: int) -> int:
    """Return the number of values of `bands` bands, 2 l + 1 for the degree l: 67 for 5 bands."""
    return sum(2 * degree + 1 for degree in degrees(bands))


def directional_encoding(directions: Tensor, roughness: Tensor, bands: int = MAX_BANDS) -> Tensor:
    """Return the mean spherical harmonics of degrees 1, 2, 4, ..., 2^(B - 1) over a distribution of directions.

    The directions have the von Mises-Fisher distribution, and equation 8 has the attenuation. The paper lists the real
    and the imaginary parts of complex harmonics; real harmonics are the same functions, scaled to be orthonormal. The
    compiled forms have first derivatives only.

    Args:
        directions: (N, 3) unit vectors, the mean directions, of any float type.
        roughness: (N,) inverse concentrations 1 / kappa, at least 0; 0 for a single direction.
        bands: number B of bands, 1 to 5 (the degree in papers).

    Returns:
        (N, sum of 2 l + 1) values, ordered by l and by m = -l ... l as in `spherical_harmonics`, each times
        exp(-l (l + 1) roughness / 2); float64 if `directions` is float64, and float32 otherwise.

    Raises:
        ValueError: if the number of bands is out of range.
    """
    if not 1 <= bands <= MAX_BANDS:
        raise ValueError(f"a directional encoding has 1 to {MAX_BANDS} bands, not {bands}")
    kind = torch.float64 if directions.dtype == torch.float64 else torch.float32
    directions, roughness = directions.to(kind), roughness.to(kind)
    return DIRECTIONAL_ENCODING((directions, roughness), directions, roughness, bands)


def directional_encoding_reference(directions: Tensor, roughness: Tensor, bands: int = MAX_BANDS) -> Tensor:
    """Compute `directional_encoding` of `directions`, `roughness` and `bands` in PyTorch, with derivatives."""
    x, y, z = directions.unbind(-1)
    last = degrees(bands)[-1]
    real, imaginary = [torch.ones_like(x)], [torch.zeros_like(x)]  # of (x + i y)^m
    for _ in range(last):
        c, s = real[-1], imaginary[-1]
        real.append(x * c - y * s)
        imaginary.append(x * s + y * c)
    cosines, sines = torch.stack(real, -1), torch.stack(imaginary, -1)
    diagonal, factors = _recurrence(last)
    before, row = z.new_zeros(len(z), 0), z.new_full((len(z), 1), diagonal[0])
    found = []
    for degree in range(1, last + 1):
        a, b = (z.new_tensor(values) for values in factors[degree])
        lower = [torch.nn.functional.pad(each, (0, degree - each.shape[1])) for each in (row, before)]
        new = a * (z[:, None] * lower[0] - b * lower[1])
        before, row = row, torch.cat([new, torch.full_like(z, diagonal[degree])[:, None]], -1)
        if degree in degrees(bands):
            kept = torch.exp(-0.5 * degree * (degree + 1) * roughness)[:, None] * row
            even = kept * cosines[:, : degree + 1]
            odd = kept[:, 1:] * sines[:, 1 : degree + 1]
            found += [math.sqrt(2) * odd.flip(-1), even[:, :1], math.sqrt(2) * even[:, 1:]]
    return torch.cat(found, dim=-1)


@lru_cache(maxsize=MAX_BANDS)
def _recurrence(last: int) -> tuple[list[float], dict[int, tuple[list[float], list[float]]]]:
    """Return the constants of the recurrence of normalised Legendre functions, which is stable in any precision.

    Without the factor (1 - z^2)^(m / 2), which is in (x + i y)^m, they are constant for m = l, and

        P_l^m = a (z P_{l-1}^m - b P_{l-2}^m)  for m < l.

    Args:
        last: the highest degree.

    Returns:
        P_m^m for m = 0 to `last`, and for each degree l its a and b for m = 0 to l - 1.
    """
    diagonal = [0.5 / math.sqrt(math.pi)]
    for m in range(1, last + 1):
        diagonal.append(-math.sqrt((2 * m + 1) / (2 * m)) * diagonal[-1])
    factors = {}
    for degree in range(1, last + 1):
        square, lower = degree**2, (degree - 1) ** 2
        orders = [m * m for m in range(degree)]
        a = [math.sqrt((4 * square - 1) / (square - m)) for m in orders]
        b = [math.sqrt((lower - m) / (4 * lower - 1)) for m in orders] if degree > 1 else [0.0]
        factors[degree] = a, b
    return diagonal, factors


DIRECTIONAL_ENCODING = Operation("directional_encoding", directional_encoding_reference)


@DIRECTIONAL_ENCODING.implementation(CPP)
def _compiled(directions: Tensor, roughness: Tensor, bands: int = MAX_BANDS) -> Tensor:
    return _DirectionalEncoding.apply(directions.contiguous(), roughness.contiguous(), bands)


class _DirectionalEncoding(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, directions: Tensor, roughness: Tensor, bands: int) -> Tensor:
        count = len(directions)

        def compute() -> Tensor:
            out = directions.new_empty(count, num_features(bands))
            _forward(
                native.pointer(directions, "directions", (count, 3)), native.pointer(roughness, "roughness", (count,)),
                count, bands, out.data_ptr(), native.threads(),
            )  # fmt: skip
            return out

        ctx.save_for_backward(directions, roughness)
        ctx.bands = bands
        return result_cache.result(("directional_encoding", bands), (directions, roughness), (), compute)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor, None]:
        (directions, roughness), grad = ctx.saved_tensors, grad.contiguous()
        count, outs = len(directions), (torch.empty_like(directions), torch.empty_like(roughness))
        address = native.pointer(grad, "the gradient", (count, num_features(ctx.bands)))
        given = directions.data_ptr(), roughness.data_ptr()
        _backward(*given, count, ctx.bands, address, *(out.data_ptr() for out in outs), native.threads())
        return *outs, None


DIRECTIONAL_ENCODING.implementation(TRITON)(later("encodings.integrated_directional_triton", "directional_encoding"))
