"""Real spherical harmonics of up to 4 bands: Instant-NGP (Mueller et al. 2022), section 5.4.

The constants are from Sloan 2008, "Stupid spherical harmonics tricks", appendix A2, with the Condon-Shortley phase.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from nerfloom.kernels import native, result_cache
from nerfloom.kernels.dispatch import CPP, FEW_OPERATIONS, TRITON, Operation
from nerfloom.kernels.triton_backend import later

MAX_LEVELS = 4
"""Maximum number of bands."""
CONSTANT = 0.28209479177387814
"""The first harmonic, constant over directions."""
PAIRS = tuple(combinations_with_replacement(range(3), 2))
"""Axes of the products x x, x y, ..., z z."""
TRIPLES = tuple((PAIRS.index((a, b)), c) for a, b, c in combinations_with_replacement(range(3), 3))
"""Pair and axis of the products x x x, x x y, ..., z z z."""
_harmonics = native.Function("spherical_harmonics", "pqipi")
_backward = native.Function("spherical_harmonics_backward", "pqippi")


def spherical_harmonics(directions: Tensor, levels: int = 4) -> Tensor:
    """Return the first real spherical harmonics Y_l^m of directions, ordered by l = 0, 1, ... and m = -l ... l.

    The compiled form has first derivatives only.

    Args:
        directions: (N, 3) unit vectors.
        levels: number of bands, 1 to 4 (the degree in papers).

    Returns:
        (N, levels^2) values of functions that are orthonormal over the sphere.

    Raises:
        ValueError: if the number of levels is out of range.
    """
    if not 1 <= levels <= MAX_LEVELS:
        raise ValueError(f"spherical harmonics have 1 to {MAX_LEVELS} levels, not {levels}")
    return SPHERICAL_HARMONICS((directions,), directions, levels)


def spherical_harmonics_reference(directions: Tensor, levels: int = 4) -> Tensor:
    """Compute `spherical_harmonics` of `directions` and `levels` in PyTorch, for any float type, with derivatives."""
    x, y, z = directions.unbind(-1)
    return torch.stack([torch.full_like(x, CONSTANT), *_polynomials(x, y, z, levels)], dim=-1)


def _polynomials(x: Any, y: Any, z: Any, levels: int) -> list[Any]:
    """Return all harmonics but the first for directions (x, y, z), tensors or numpy arrays."""
    bands = []
    if levels > 1:
        bands += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if levels > 2:
        bands += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (3 * z * z - 1),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if levels > 3:
        bands += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (5 * z * z - 1),
            0.3731763325901154 * z * (5 * z * z - 3),
            -0.4570457994644658 * x * (5 * z * z - 1),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    return bands


SPHERICAL_HARMONICS = Operation("spherical_harmonics", spherical_harmonics_reference)


@SPHERICAL_HARMONICS.implementation(CPP)
def _compiled(directions: Tensor, levels: int = 4) -> Tensor:
    return _Harmonics.apply(directions.contiguous(), levels)


class _Harmonics(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, directions: Tensor, levels: int) -> Tensor:
        count = len(directions)

        def compute() -> Tensor:
            out = directions.new_empty(count, levels**2)
            address = native.pointer(directions, "directions", (count, 3))
            _harmonics(address, count, levels, out.data_ptr(), native.threads())
            return out

        ctx.save_for_backward(directions)
        ctx.levels = levels
        return result_cache.result(("spherical_harmonics", levels), (directions,), (), compute)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        (directions,), grad = ctx.saved_tensors, grad.contiguous()
        count, out = len(directions), torch.empty_like(directions)
        address = native.pointer(grad, "the gradient", (count, ctx.levels**2))
        _backward(directions.data_ptr(), count, ctx.levels, address, out.data_ptr(), native.threads())
        return out, None


SPHERICAL_HARMONICS.implementation(TRITON, order=0)(later("encodings.encodings_triton", "spherical_harmonics"))


class _Products(NamedTuple):
    """The harmonics as sums of products of coordinates, on a device."""

    pairs: Tensor
    """(2, 6) int64, `PAIRS`."""
    triples: Tensor
    """(2, 10) int64, `TRIPLES`."""
    constants: Tensor
    """(levels^2,) constant terms."""
    factors: Tensor
    """(K, levels^2) factors of the products of 1 to levels - 1 coordinates."""


@lru_cache(maxsize=64)
def _products(levels: int, dtype: torch.dtype, device: torch.device) -> _Products:
    """Return the sums, computed from values of the polynomials at more positions than there are products."""
    positions = np.random.default_rng(0).uniform(-1, 1, (64, 3))
    ones, columns = np.ones(64), (positions[:, 0], positions[:, 1], positions[:, 2])
    twos = [columns[a] * columns[b] for a, b in PAIRS]
    known = [ones, *columns, *twos, *(twos[pair] * columns[c] for pair, c in TRIPLES)][: (1, 4, 10, 20)[levels - 1]]
    values = np.stack([CONSTANT * ones, *_polynomials(*columns, levels)], -1)
    found = np.linalg.lstsq(np.stack(known, -1), values, rcond=None)[0]
    constants, *factors = np.where(np.abs(found) < 1e-12, 0, found).tolist()
    indices = [torch.tensor(axes, device=device).t().contiguous() for axes in (PAIRS, TRIPLES)]
    return _Products(*indices, *(torch.tensor(each, dtype=dtype, device=device) for each in (constants, factors)))


@SPHERICAL_HARMONICS.implementation(
    FEW_OPERATIONS, types=None, order=torch.inf, fits=lambda directions, levels=4: levels > 1
)
def _as_product(directions: Tensor, levels: int = 4) -> Tensor:
    """Compute `spherical_harmonics` as one matrix product, for any device and float type."""
    known = _products(levels, directions.dtype, directions.device)
    parts = [directions]
    if levels > 2:
        parts.append(directions.index_select(1, known.pairs[0]) * directions.index_select(1, known.pairs[1]))
    if levels > 3:
        parts.append(parts[1].index_select(1, known.triples[0]) * directions.index_select(1, known.triples[1]))
    with torch.autocast(directions.device.type, torch.bfloat16, enabled=False):  # autocast rounds products
        return torch.addmm(known.constants, torch.cat(parts, dim=-1), known.factors)
