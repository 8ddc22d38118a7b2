"""Adam (Kingma and Ba 2015), dense, and sparse for tables with few entries used in a step.

Sparse Adam updates an entry only if its gradient is not zero. The moments of the entry decay, and their bias is
corrected, by the number of its updates, not by the number of steps. So an entry first used after a thousand steps moves
by the same length as in a first step. (Instant-NGP's optimiser skips entries in the same way; Mueller et al. 2022,
section 4.)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.optim.adam import adam

from nerfloom.kernels import native
from nerfloom.kernels.dispatch import CPP, FEW_OPERATIONS, TORCH, TRITON, Operation
from nerfloom.kernels.triton_backend import later

_sparse = native.Function("adam_sparse", "pppppqifddfi", "q")
_dense = native.Function("adam_dense", "ppppppifddfi")
_finite = native.Function("all_finite", "pqi", "i")


@torch.no_grad()
def sparse_adam_reference(
    values: Tensor, grad: Tensor, mean: Tensor, square: Tensor, seen: Tensor,
    rate: float | Tensor, betas: tuple[float, float], eps: float, found_inf: Tensor | None = None,
) -> int | Tensor:  # fmt: skip
    """Compute `sparse_adam` in PyTorch, on any device and for any float type.

    `values`, `grad`, `mean`, `square`, `seen`, `rate`, `betas`, `eps` and `found_inf` are as in `sparse_adam`.
    """
    if found_inf is not None and bool(found_inf):
        grad.zero_()
        return 0
    rows = (grad != 0).any(-1).nonzero().squeeze(-1)
    g = grad[rows]
    seen[rows] += 1
    # expm1 rather than 1 - beta^count, which would lose digits in the type of the values; all devices have that type.
    count, logs = seen[rows], [math.log(beta) if beta else -math.inf for beta in betas]
    mean[rows] = betas[0] * mean[rows] + (1 - betas[0]) * g
    square[rows] = betas[1] * square[rows] + (1 - betas[1]) * g * g
    unbias1, unbias2 = ((-1 / torch.expm1(count * log)).to(values.dtype)[:, None] for log in logs)
    values[rows] -= rate * unbias1 * mean[rows] / ((unbias2 * square[rows]).sqrt() + eps)
    grad[rows] = 0
    return len(rows)


def sparse_adam(
    values: Tensor, grad: Tensor, mean: Tensor, square: Tensor, seen: Tensor,
    rate: float | Tensor, betas: tuple[float, float], eps: float, found_inf: Tensor | None = None,
) -> int | Tensor:  # fmt: skip
    """Update, in place, the entries with a gradient that is not zero, and set their gradient to zero.

    Args:
        values: (E, F) parameters.
        grad: (E, F) gradient; an entry of zeros is not updated.
        mean: (E, F) first moments.
        square: (E, F) second moments.
        seen: (E,) number of updates of each entry, counted at least until the bias corrections are 1 in float32.
        rate: learning rate, possibly on the device, () float32.
        betas: decay rates of the two moments.
        eps: added to the square root of the second moment.
        found_inf: () float32 on the device, 1 if a gradient of the step is not finite, so that no entry is updated,
            otherwise 0; None for 0.

    Returns:
        The number of updated entries, which may still be on the device, () int64.
    """
    tensors = values, grad, mean, square, seen
    return SPARSE_ADAM(tensors, *tensors, rate, betas, eps, found_inf)


SPARSE_ADAM: Operation[..., int | Tensor] = Operation("sparse_adam", sparse_adam_reference)


def _known_to_python(*given: Any) -> bool:
    rate, _, _, found_inf = given[5:]
    return found_inf is None and not isinstance(rate, Tensor)


@SPARSE_ADAM.implementation(CPP, fits=_known_to_python)
def _sparse_adam(
    values: Tensor, grad: Tensor, mean: Tensor, square: Tensor, seen: Tensor,
    rate: float | Tensor, betas: tuple[float, float], eps: float, found_inf: Tensor | None = None,
) -> int | Tensor:  # fmt: skip
    shape = (values.shape[0], values.shape[1])
    updated: int = _sparse(
        native.pointer(values, "values", shape), native.pointer(mean, "mean", shape),
        native.pointer(square, "square", shape), native.pointer(grad, "grad", shape),
        native.pointer(seen, "seen", shape[:1]), *shape, rate, *betas, eps, native.threads(),
    )  # fmt: skip
    return updated


@SPARSE_ADAM.implementation(FEW_OPERATIONS, types=None)
@torch.no_grad()
def _masked_adam(
    values: Tensor, grad: Tensor, mean: Tensor, square: Tensor, seen: Tensor,
    rate: float | Tensor, betas: tuple[float, float], eps: float, found_inf: Tensor | None = None,
) -> int | Tensor:  # fmt: skip
    """Update all entries, by zero if the gradient is zero, so that the device need not report which have one."""
    if found_inf is not None:
        grad.masked_fill_(found_inf != 0, 0)
    touched = (grad != 0).any(-1)
    seen += touched
    used, count = touched[:, None].to(values.dtype), seen.clamp(min=1)[:, None]
    mean.mul_(1 - (1 - betas[0]) * used).add_(grad, alpha=1 - betas[0])
    square.mul_(1 - (1 - betas[1]) * used).addcmul_(grad, grad, value=1 - betas[1])
    logs = [math.log(beta) if beta else -math.inf for beta in betas]
    unbias1, unbias2 = (torch.expm1(count * log).reciprocal_().neg_() for log in logs)
    scale = (unbias2 * square).sqrt_().add_(eps)
    # An entry that has never had a gradient may have a scale of 0.
    values.addcdiv_(mean * (unbias1 * used) * -rate, torch.where(touched[:, None], scale, 1))
    grad.zero_()
    return touched.sum()


SPARSE_ADAM.implementation(TRITON, fits=lambda *given: all(tensor.is_contiguous() for tensor in given[:5]))(
    later("adam.adam_triton", "sparse_adam")
)


@torch.no_grad()
def dense_adam_reference(
    values: Sequence[Tensor], grads: Sequence[Tensor], means: Sequence[Tensor], squares: Sequence[Tensor],
    steps: Sequence[Tensor], rate: float | Tensor, betas: tuple[float, float], eps: float,
    found_inf: Tensor | None = None,
) -> None:  # fmt: skip
    """Compute `dense_adam` in PyTorch, on any device and for any float type.

    `values`, `grads`, `means`, `squares`, `steps`, `rate`, `betas`, `eps` and `found_inf` are as in `dense_adam`.
    """
    if found_inf is not None and bool(found_inf):
        return
    for value, grad, mean, square, step in zip(values, grads, means, squares, steps, strict=True):
        step += 1
        mean.lerp_(grad, 1 - betas[0])
        square.mul_(betas[1]).addcmul_(grad, grad, value=1 - betas[1])
        unbias1, unbias2 = (1 - beta ** step.item() for beta in betas)
        value.addcdiv_(mean, square.sqrt() / math.sqrt(unbias2) + eps, value=-float(rate) / unbias1)


def dense_adam(
    values: Sequence[Tensor], grads: Sequence[Tensor], means: Sequence[Tensor], squares: Sequence[Tensor],
    steps: Sequence[Tensor], rate: float | Tensor, betas: tuple[float, float], eps: float,
    found_inf: Tensor | None = None,
) -> None:  # fmt: skip
    """Update, in place, all values of several parameters: Kingma and Ba 2015, algorithm 1.

    Args:
        values: the parameters, each of any shape.
        grads: gradient of each parameter, of the same shape.
        means: first moments of each parameter, of the same shape.
        squares: second moments of each parameter, of the same shape.
        steps: () float32 number of updates of each parameter, incremented by 1.
        rate: learning rate, possibly on the device, () float32.
        betas: decay rates of the two moments.
        eps: added to the square root of the second moment.
        found_inf: () float32 on the device, 1 if a gradient of the step is not finite, so that nothing is updated,
            otherwise 0; None for 0.
    """
    DENSE_ADAM((*values, *grads), values, grads, means, squares, steps, rate, betas, eps, found_inf)


DENSE_ADAM: Operation[..., None] = Operation("dense_adam", dense_adam_reference)


def _compiled_fits(*given: Any) -> bool:
    values, grads, *_, rate, _, _, found_inf = given
    known = found_inf is None and not isinstance(rate, Tensor)
    return known and all(tensor.is_contiguous() for tensor in (*values, *grads))


@DENSE_ADAM.implementation(CPP, fits=_compiled_fits)
def _dense_adam(
    values: Sequence[Tensor], grads: Sequence[Tensor], means: Sequence[Tensor], squares: Sequence[Tensor],
    steps: Sequence[Tensor], rate: float | Tensor, betas: tuple[float, float], eps: float,
    found_inf: Tensor | None = None,
) -> None:  # fmt: skip
    columns = [
        native.pointers([native.pointer(t, name, tuple(v.shape)) for t, v in zip(tensors, values, strict=True)])
        for name, tensors in (("values", values), ("mean", means), ("square", squares), ("grad", grads))
    ]
    for step in steps:
        step += 1
    counts, times = native.integers(tuple(v.numel() for v in values)), native.doubles([float(s) for s in steps])
    _dense(*columns, counts, times, len(values), rate, *betas, eps, native.threads())


@DENSE_ADAM.implementation(TORCH, types=None)
def _torch_adam(
    values: Sequence[Tensor], grads: Sequence[Tensor], means: Sequence[Tensor], squares: Sequence[Tensor],
    steps: Sequence[Tensor], rate: float | Tensor, betas: tuple[float, float], eps: float,
    found_inf: Tensor | None = None,
) -> None:  # fmt: skip
    adam(
        [*values], [*grads], [*means], [*squares], [], [*steps], fused=True, found_inf=found_inf, amsgrad=False,
        beta1=betas[0], beta2=betas[1], lr=rate, weight_decay=0.0, eps=eps, maximize=False,
    )  # fmt: skip


def all_finite_reference(values: Sequence[Tensor]) -> bool | Tensor:
    """Compute `all_finite` of `values` in PyTorch, on any device."""
    return all(bool(torch.isfinite(value).all()) for value in values)


def all_finite(values: Sequence[Tensor]) -> bool | Tensor:
    """Return whether all values of several tensors are finite, in one pass over each.

    Args:
        values: float tensors of any shapes on one device.

    Returns:
        The answer, which may still be on the device, () bool.
    """
    return ALL_FINITE(values, values)


ALL_FINITE: Operation[[Sequence[Tensor]], bool | Tensor] = Operation("all_finite", all_finite_reference)


@ALL_FINITE.implementation(CPP, fits=lambda values: all(value.is_contiguous() for value in values))
def _all_finite(values: Sequence[Tensor]) -> bool | Tensor:
    return all(_finite(value.data_ptr(), value.numel(), native.threads()) for value in values)


@ALL_FINITE.implementation(FEW_OPERATIONS, types=None)
@torch.no_grad()
def _largest_is_finite(values: Sequence[Tensor]) -> bool | Tensor:
    """Compute the answer on the device: the largest magnitude is finite only if all are; NaN is largest."""
    filled = [value for value in values if value.numel()]
    return torch.stack([*torch._foreach_norm(filled, torch.inf)]).isfinite().all() if filled else True
