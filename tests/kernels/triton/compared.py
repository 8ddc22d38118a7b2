"""Comparison of Triton's kernels with the references in float64: values, and gradients of all inputs that have one."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor

from nerfloom.kernels import triton_backend
from nerfloom.kernels.dispatch import FEW_OPERATIONS, Operation

DEVICE = torch.device("cpu" if triton_backend.INTERPRETED else "cuda")
Function = Callable[..., Tensor | Sequence[Tensor]]


@contextmanager
def backends() -> Iterator[list[str]]:
    """Names of the backends that operations choose within the block."""
    names: list[str] = []
    choose = Operation.choose

    def noted(self: Operation, *args: Any, **kwargs: Any) -> Any:
        implementation = choose(self, *args, **kwargs)
        if implementation.backend is FEW_OPERATIONS:  # which float64 takes on the CPU without the C++ kernels
            implementation = self.reference
        names.append(implementation.backend.name)
        return implementation

    with patch.object(Operation, "choose", noted):
        yield names


def error(value: Tensor, truth: Tensor) -> float:
    """Largest difference over the largest magnitude of the truth, at least 1e-6; infinity and NaN must be where its
    are."""
    value, truth = value.detach().double().cpu(), truth.detach().double().cpu()
    assert value.shape == truth.shape
    if not truth.numel():
        return 0.0
    # float32 has no numbers above 3.4e38.
    truth = torch.where(truth.abs() > torch.finfo(torch.float32).max, truth.sign() * torch.inf, truth)
    odd = ~truth.isfinite()
    assert torch.equal(odd, ~value.isfinite())
    torch.testing.assert_close(value[odd], truth[odd], equal_nan=True)
    differences = (value - truth).masked_fill(odd, 0).abs().max().item()
    return differences / max(truth.masked_fill(odd, 0).abs().max().item(), 1e-6)


def compare(
    function: Function, inputs: dict[str, Tensor], followed: str = "", tolerance: float = 1e-5, expected: str = "triton"
) -> list[Tensor]:
    """Run a function on float32 inputs, and on the same in float64, where the reference runs; return the results.

    Gradients of the inputs named in `followed` come from the results times fixed random numbers.
    """
    found = []
    for dtype, device, name in ((torch.float32, DEVICE, expected), (torch.float64, torch.device("cpu"), "reference")):
        given = {key: value.to(device, dtype, copy=True) for key, value in inputs.items()}
        for key in followed.split():
            given[key].requires_grad_()
        with backends() as names:
            results = function(**given)
        assert set(names) == {name}
        results = [results] if isinstance(results, Tensor) else list(results)
        if followed:
            random = torch.Generator().manual_seed(7)
            total = torch.zeros((), dtype=dtype, device=device)
            for result in (result for result in results if result.requires_grad):
                factors = torch.rand(result.shape, generator=random) * 2 - 0.5
                # Infinities and NaNs would hide all gradients.
                total = total + (result * factors.to(result)).masked_fill(~result.detach().isfinite(), 0).sum()
            results += torch.autograd.grad(total, [given[key] for key in followed.split()])
        found.append([result.detach() for result in results])
    errors = [error(value, truth) for value, truth in zip(*found, strict=True)]
    print("errors: " + " ".join(f"{each:.0e}" for each in errors))
    assert max(errors, default=0.0) < tolerance, errors
    return found[0]
