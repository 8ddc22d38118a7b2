"""Maximum errors of Triton's kernels, values and gradients, against the references in float64.

On a GPU the kernels run there. Otherwise they run in Triton's interpreter on the CPU, in a separate process, because
Triton must know before its import whether it interprets.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from rich.box import SIMPLE
from rich.table import Table
from torch import Tensor

from nerfloom.base.child import python_command
from nerfloom.base.errors import ConfigError
from nerfloom.benchmarks.kernel_cases import KINDS, Case, cases
from nerfloom.kernels import dispatch, triton_backend
from nerfloom.kernels.dispatch import Operation

MIN_SCALE = 1e-6
"""For values below this, errors are reported relative to this instead."""
MAX_FLOAT = torch.finfo(torch.float32).max


@dataclass(frozen=True)
class Error:
    """Errors of a kernel at one kind of inputs."""

    kernel: str
    """Name of the operation."""
    kind: str
    """random, extreme or empty."""
    value: float
    """Maximum error of a value, relative to the largest value; infinity if a value is not finite but should be."""
    gradient: float | None
    """Maximum error of a gradient, relative to the largest; None without gradients."""


def measured(device: torch.device) -> list[Error]:
    """Return the errors of all kernels on `device`: a GPU, or the CPU if Triton interprets.

    Raises:
        ConfigError: if a Triton operation has no case or did not run.
    """
    found = [_of_case(case, device) for case in cases()]
    table = dispatch.table()
    missing = {name for name, backends in table.items() if "triton" in backends} - {each.kernel for each in found}
    if missing:
        raise ConfigError(f"kernel_cases.py has no inputs for {', '.join(sorted(missing))}; add them")
    return found


def _of_case(case: Case, device: torch.device) -> Error:
    taken: set[tuple[str, str]] = set()
    choose = Operation.choose

    def noted(self: Operation[..., Any], *args: Any, **kwargs: Any) -> Any:
        implementation = choose(self, *args, **kwargs)
        taken.add((self.name, implementation.backend.name))
        return implementation

    with patch.object(Operation, "choose", noted):
        values, gradients = _computed(case, device, torch.float32)
    if (case.kernel, "triton") not in taken and case.kind != "empty":
        raise ConfigError(f"{case.kernel} on {device.type} was computed by {sorted(taken)}, not by Triton")
    exact_values, exact_gradients = _computed(case, torch.device("cpu"), torch.float64)
    slopes = [largest_error(*pair) for pair in zip(gradients, exact_gradients, strict=True)]
    errors = [largest_error(*pair) for pair in zip(values, exact_values, strict=True)]
    return Error(case.kernel, case.kind, max(errors, default=0.0), max(slopes, default=None))


def _computed(case: Case, device: torch.device, kind: torch.dtype) -> tuple[list[Tensor], list[Tensor]]:
    """Return the results of a case, and the gradients of their sum, weighted by fixed random numbers."""
    given = {name: value.to(device, kind, copy=True) for name, value in case.inputs.items()}
    followed = [given[name].requires_grad_() for name in case.followed.split()]
    with torch.set_grad_enabled(bool(followed)):
        results = list(case.run(**given))
    if not followed:
        return results, []
    random, total = torch.Generator().manual_seed(7), torch.zeros((), dtype=kind, device=device)
    for result in results:
        factors = (torch.rand(result.shape, generator=random) * 2 - 0.5).to(result)
        if result.requires_grad:  # infinite or NaN results would hide all gradients
            total = total + (result * factors).masked_fill(~result.detach().isfinite(), 0).sum()
    gradients = torch.autograd.grad(total, followed, allow_unused=True)
    zeros = [torch.zeros_like(leaf) for leaf in followed]
    return results, [zero if slope is None else slope for slope, zero in zip(gradients, zeros, strict=True)]


def largest_error(value: Tensor, truth: Tensor) -> float:
    """Return the maximum error of `value` over the largest `truth`; infinity where only one of the two is finite."""
    value, truth = value.detach().double().cpu(), truth.detach().double().cpu()
    if value.shape != truth.shape:
        return float("inf")
    if not truth.numel():
        return 0.0
    truth = torch.where(truth.abs() > MAX_FLOAT, truth.sign() * torch.inf, truth)  # out of range of float32
    odd = ~truth.isfinite()
    if not torch.equal(odd, ~value.isfinite()):
        return float("inf")
    error, largest = ((each.masked_fill(odd, 0)).abs().max() for each in (value - truth, truth))
    return float(error / largest.clamp(min=MIN_SCALE))


def interpreted() -> list[Error]:
    """Return the errors of all kernels in Triton's interpreter, in another process.

    Raises:
        ConfigError: if it fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "errors.json"
        given = {**os.environ, "TRITON_INTERPRET": "1", "NERFLOOM_KERNELS": "triton"}
        if subprocess.run(python_command("nerfloom.benchmarks.kernel_errors", path), env=given).returncode:
            raise ConfigError("Triton's interpreter failed; the lines above say why")
        return [Error(**row) for row in json.loads(path.read_text(encoding="utf-8"))]


def as_table(rows: Sequence[Error]) -> Table:
    """Return a table of the errors `rows`, with a line for each kernel."""
    grid = Table(title="largest relative errors: value, gradient", title_justify="left", box=SIMPLE)
    for heading in ("kernel", *KINDS):
        grid.add_column(heading, justify="left" if heading == "kernel" else "right")
    for kernel in dict.fromkeys(row.kernel for row in rows):
        here = {row.kind: row for row in rows if row.kernel == kernel}
        grid.add_row(kernel, *(_shown(here[kind]) for kind in KINDS))
    return grid


def _shown(row: Error) -> str:
    return f"{row.value:.0e}" + ("" if row.gradient is None else f", {row.gradient:.0e}")


def faster_interpreter() -> None:
    """Make Triton's interpreter replace Triton's functions once per file; at each call it takes most of the time."""
    from triton.language import core
    from triton.runtime import interpreter

    class Kept:
        def restore(self) -> None:
            """Leave the functions replaced."""

    replace, replaced = interpreter._patch_lang, set[int]()

    def once(function: Any) -> Any:
        if id(function.__globals__) not in replaced:
            replaced.add(id(function.__globals__))
            replace(function)
            # Triton 3.6's converts arrays of one number to numbers, which numpy 2.4 refuses.
            core.tensor.__index__ = lambda self: int(self.handle.data.squeeze())
        return Kept()

    interpreter._patch_lang = once


def main() -> None:
    """Write the errors of all kernels in the interpreter to a file, in a process that interprets."""
    if not triton_backend.available():
        raise ConfigError("Triton cannot be imported: pip install triton")
    faster_interpreter()
    errors = [asdict(row) for row in measured(torch.device("cpu"))]
    Path(sys.argv[1]).write_text(json.dumps(errors), encoding="utf-8")


if __name__ == "__main__":
    main()
