"""Adam (Kingma and Ba 2015), dense, and on a table of which a step touches few entries.

Each entry sees Adam on the sequence of its own gradients that are not zero: its moments decay, and their bias is
corrected, by the number of updates it has had, not by the number of steps. So an entry that is met for the first time
after a thousand steps, or not for a thousand steps, moves as far as it should (Instant-NGP's optimiser skips entries
the same way; Mueller et al. 2022, section 4).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from framework.kernels import native

_sparse = native.function("adam_sparse", "pppppqifddfi", "q")
_dense = native.function("adam_dense", "ppppppifddfi")
_finite = native.function("all_finite", "pqi", "i")


@torch.no_grad()
def sparse_adam_reference(
    values: Tensor, grad: Tensor, mean: Tensor, square: Tensor, seen: Tensor,
    rate: float, betas: tuple[float, float], eps: float,
) -> int:  # fmt: skip
    """As `sparse_adam`, in torch, on any device and in any float type."""
    rows = (grad != 0).any(-1).nonzero().squeeze(-1)
    g = grad[rows]
    seen[rows] += 1
    # In the values' own type, which all devices have: 1 - beta^count by powers would lose digits.
    count, logs = seen[rows], [math.log(beta) if beta else -math.inf for beta in betas]
    mean[rows] = betas[0] * mean[rows] + (1 - betas[0]) * g
    square[rows] = betas[1] * square[rows] + (1 - betas[1]) * g * g
    unbias1, unbias2 = ((-1 / torch.expm1(count * log)).to(values.dtype)[:, None] for log in logs)
    values[rows] -= rate * unbias1 * mean[rows] / ((unbias2 * square[rows]).sqrt() + eps)
    grad[rows] = 0
    return len(rows)


def sparse_adam(
    values: Tensor, grad: Tensor, mean: Tensor, square: Tensor, seen: Tensor,
    rate: float, betas: tuple[float, float], eps: float,
) -> int:  # fmt: skip
    """Update, in place, the entries that have a gradient, and set their gradient to zero.

    Args:
        values: (E, F) parameters.
        grad: (E, F) gradient; an entry of zeros is left alone.
        mean, square: (E, F) moments.
        seen: (E,) updates each entry has had, counted at least until the corrections are 1 in float32.
        rate: learning rate.
        betas: decay of the two moments.
        eps: added to the root of the second.
    Returns: how many entries were updated.
    """
    if not native.usable(values, grad, mean, square, seen):
        return sparse_adam_reference(values, grad, mean, square, seen, rate, betas, eps)
    shape = (values.shape[0], values.shape[1])
    return _sparse(
        native.pointer(values, "values", shape), native.pointer(mean, "mean", shape),
        native.pointer(square, "square", shape), native.pointer(grad, "grad", shape),
        native.pointer(seen, "seen", shape[:1]), *shape, rate, *betas, eps, native.threads(),
    )  # fmt: skip


@torch.no_grad()
def dense_adam_reference(
    values: Tensor, grad: Tensor, mean: Tensor, square: Tensor, step: float,
    rate: float, betas: tuple[float, float], eps: float,
) -> None:  # fmt: skip
    """As `dense_adam` of one tensor, in torch, on any device and in any float type."""
    mean.lerp_(grad, 1 - betas[0])
    square.mul_(betas[1]).addcmul_(grad, grad, value=1 - betas[1])
    unbias1, unbias2 = (1 - beta**step for beta in betas)
    values.addcdiv_(mean, square.sqrt() / math.sqrt(unbias2) + eps, value=-rate / unbias1)


def dense_adam(
    values: Sequence[Tensor], grads: Sequence[Tensor], means: Sequence[Tensor], squares: Sequence[Tensor],
    steps: Sequence[float], rate: float, betas: tuple[float, float], eps: float,
) -> None:  # fmt: skip
    """Update, in place, every value of several parameters (Kingma and Ba 2015, algorithm 1), compiled.

    Args:
        values, grads, means, squares: contiguous float32 on the CPU, of the same shapes.
        steps: updates each parameter has had, this one included.
        rate, betas, eps: as for `sparse_adam`.
    """
    columns = [
        native.pointers([native.pointer(t, name, tuple(v.shape)) for t, v in zip(tensors, values, strict=True)])
        for name, tensors in (("values", values), ("mean", means), ("square", squares), ("grad", grads))
    ]
    counts = native.integers(tuple(v.numel() for v in values))
    _dense(*columns, counts, native.doubles(steps), len(values), rate, *betas, eps, native.threads())


def all_finite(values: Tensor) -> bool:
    """Whether no value is infinite or NaN, in one pass."""
    if native.usable(values) and values.is_contiguous():
        return bool(_finite(values.data_ptr(), values.numel(), native.threads()))
    return bool(torch.isfinite(values).all())
