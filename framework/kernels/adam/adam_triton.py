"""Sparse Adam, in Triton. `nerfloom.kernels.adam.adam` has the reference."""

# mypy: allow-untyped-defs, allow-untyped-decorators, allow-incomplete-defs
# Triton gives the kernels' arguments their types.

from __future__ import annotations

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerfloom.kernels.triton_launch import blocks, launch, on_device, opacity_of, own_rows

BLOCK = 1024
"""Number of values per program."""


@triton.jit(do_not_specialize=["entries"])
def _sparse(
    values, grad, mean, square, seen, updated, rate, found_inf, entries, features, keep1, keep2, add1, add2,
    decay1, decay2, eps,
    ROWS: tl.constexpr, F: tl.constexpr,
):  # fmt: skip
    e, here = own_rows(entries, ROWS)
    f = tl.arange(0, F)
    at = e[:, None] * features + f[None, :]
    there = here[:, None] & (f < features)[None, :]
    g = tl.load(grad + at, mask=there, other=0.0)
    used = tl.max((g != 0).to(tl.int32), 1) != 0
    tl.store(grad + at, tl.zeros_like(g), mask=there & used[:, None])
    if found_inf is not None:
        g = tl.where(tl.load(found_inf) == 0, g, 0.0)
        used = tl.max((g != 0).to(tl.int32), 1) != 0
    mask = there & used[:, None]
    tl.atomic_add(updated, tl.sum(used.to(tl.int64), 0), sem="relaxed")
    count = tl.load(seen + e, mask=used, other=0.0) + 1
    tl.store(seen + e, count, mask=used)
    # 1 / (1 - beta^count), which would lose digits if beta^count is close to 1.
    unbias1, unbias2 = 1 / opacity_of(count * decay1), 1 / opacity_of(count * decay2)
    m = keep1 * tl.load(mean + at, mask=mask, other=0.0) + add1 * g
    v = keep2 * tl.load(square + at, mask=mask, other=0.0) + add2 * g * g
    tl.store(mean + at, m, mask=mask)
    tl.store(square + at, v, mask=mask)
    moved = tl.load(rate) * unbias1[:, None] * m / (tl.sqrt(unbias2[:, None] * v) + eps)
    tl.store(values + at, tl.load(values + at, mask=mask, other=0.0) - moved, mask=mask)


def sparse_adam(
    values: Tensor, grad: Tensor, mean: Tensor, square: Tensor, seen: Tensor,
    rate: float | Tensor, betas: tuple[float, float], eps: float, found_inf: Tensor | None = None,
) -> Tensor:  # fmt: skip
    """Compute `nerfloom.kernels.adam.adam.sparse_adam`; the number of entries stays on the GPU.

    `values`, `grad`, `mean`, `square`, `seen`, `rate`, `betas`, `eps` and `found_inf` are as there.
    """
    entries, features = values.shape
    width = triton.next_power_of_2(features)
    rows = max(BLOCK // width, 1)
    updated = torch.zeros((), dtype=torch.int64, device=values.device)
    decays = (-math.log(beta) if beta else math.inf for beta in betas)
    launch(
        _sparse, (blocks(entries, rows),), values, grad, mean, square, seen, updated, on_device(rate, values),
        found_inf, entries, features, *betas, *(1 - beta for beta in betas), *decays, eps, ROWS=rows, F=width,
    )  # fmt: skip
    return updated
