"""A compiled kernel and its torch reference: runs of both, and their errors against float64."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from nerfloom.benchmarks.ceilings import Work
from nerfloom.benchmarks.timing import Run, differentiated


@dataclass(frozen=True)
class Errors:
    """Relative errors against float64.

    The maximum error of a gradient would say little, because gradients are discontinuous at faces of cells and with
    ReLU.
    """

    value: float
    """Maximum error over the maximum value."""
    gradient: float | None
    """Root mean square error relative to the gradient's, for the worst input; None without gradients."""


@dataclass(frozen=True)
class Kernel:
    """The compiled kernel `name` and its reference."""

    name: str
    unit: str
    """Unit of its work: sample, ray, entry, pixel, Gaussian, or pair of a Gaussian and a pixel."""
    count: int
    """Number of units per run."""
    runs: tuple[Run, Run]
    """Runs of the compiled kernel and of the reference."""
    work: Work | None
    """Work of the forward pass per unit; None if no limit applies."""
    errors: Callable[[], tuple[Errors, Errors]] | None = None
    """Function that returns the errors of the compiled kernel and of the reference in float32."""


def of_function(
    name: str,
    inputs: list[Tensor],
    compiled: Callable[..., Tensor],
    reference: Callable[..., Tensor],
    work: Work,
    backward: bool = True,
    unit: str = "sample",
    count: int | None = None,
) -> Kernel:
    """Return the kernel `name`, a function of tensors.

    Args:
        inputs: arguments of both functions.
        compiled, reference: the functions.
        work: work of the forward pass per unit.
        backward: whether to measure the backward pass too.
        unit, count: as in `Kernel`; if `count` is None, a row of the first argument is a unit.
    """
    return Kernel(
        name,
        unit,
        len(inputs[0]) if count is None else count,
        (differentiated(compiled, inputs, None, backward), differentiated(reference, inputs, None, backward)),
        work,
        lambda: (errors(compiled, reference, inputs, backward), errors(reference, reference, inputs, backward)),
    )


def errors(
    function: Callable[..., Tensor], truth: Callable[..., Tensor], inputs: Sequence[Tensor], backward: bool
) -> Errors:
    """Return errors at `inputs` of `function` in float32 against `truth` in float64; of gradients if `backward`."""
    (value, *gradients), (exact, *exact_gradients) = (
        _value_and_gradients(run, inputs, kind, backward)
        for run, kind in ((function, torch.float32), (truth, torch.float64))
    )
    worst = [
        ((gradient.double() - true).square().mean() / true.square().mean()).sqrt().item()
        for gradient, true in zip(gradients, exact_gradients, strict=True)
        if true.abs().max() > 0
    ]
    largest = ((value.double() - exact).abs().max() / exact.abs().max()).item()
    return Errors(largest, max(worst) if worst else None)


def _value_and_gradients(
    function: Callable[..., Tensor], inputs: Sequence[Tensor], kind: torch.dtype, backward: bool
) -> list[Tensor]:
    leaves = [tensor.detach().to(kind, copy=True).requires_grad_(backward) for tensor in inputs]
    value = function(*leaves)
    if backward:
        (value * torch.linspace(-1, 1, value.numel()).view_as(value).to(kind)).sum().backward()
    return [value.detach(), *(leaf.grad for leaf in leaves if leaf.grad is not None)]
