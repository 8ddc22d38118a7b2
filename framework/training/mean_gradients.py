"""Averages of gradients over several processes, before the optimiser's step.

`torch.nn.parallel.DistributedDataParallel` averages in autograd hooks, which never run for tables with deferred
gradients (`kernels.adam.deferred`). This module sums gradients explicitly: large tables in place, and all other
parameters in one tensor, since each exchange has an overhead.
"""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.base.errors import LostProcessError
from nerfloom.base.processes import add_up, gathered, processes
from nerfloom.training.optim import Adam

MIN_SEPARATE_SIZE = 2**18
"""Minimum number of elements of a gradient that is summed separately."""


@torch.no_grad()
def mean_gradients(optimizer: Adam, finite: bool | Tensor) -> bool | Tensor:
    """Replace the gradients by their means over all processes, unless one of them is not finite.

    A missing gradient of a process counts as zero. A parameter without a gradient in any process gets none.

    Args:
        optimizer: the optimiser, after the backward pass.
        finite: whether all gradients of this process are finite; () bool if still on the device.

    Returns:
        Whether all gradients of all processes are finite; a Python bool if there are several processes.

    Raises:
        LostProcessError: if another process has ended, or the parameters of the processes differ in size.
    """
    count = processes().count
    if count == 1:
        return finite
    parameters = optimizer.parameters
    own = [parameter.numel() * optimizer.has_gradient(parameter) for parameter in parameters]
    finite_there, *sizes = zip(*gathered([bool(finite), *own]), strict=True)
    if not all(finite_there):
        return False
    if any(len({*column} - {0}) > 1 for column in sizes):
        raise LostProcessError("the processes' models differ in size; they need the same packages, CPUs and GPUs")
    gradients = [optimizer.gradient(p) for p, column in zip(parameters, sizes, strict=True) if any(column)]
    apart = [gradient for gradient in gradients if gradient.numel() >= MIN_SEPARATE_SIZE and gradient.is_contiguous()]
    for gradient in apart:
        add_up(gradient.div_(count))
    _mean_together([gradient for gradient in gradients if all(gradient is not other for other in apart)], count)
    return True


def _mean_together(gradients: list[Tensor], count: int) -> None:
    """Replace gradients by their means over `count` processes, in one exchange."""
    if gradients:
        flat = add_up(torch.cat([gradient.reshape(-1) for gradient in gradients]).div_(count))
        for gradient, mean in zip(gradients, flat.split([g.numel() for g in gradients]), strict=True):
            gradient.copy_(mean.view_as(gradient))
