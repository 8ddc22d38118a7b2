"""Kernels on a GPU, with errors, torch's times and the device's limits; steps as CUDA graphs; PSNR over time."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.console import console, say
from nerfloom.base.device import wait_for
from nerfloom.benchmarks.ceilings import Ceilings, Work
from nerfloom.benchmarks.compared import Kernel, of_function
from nerfloom.benchmarks.kernel_errors import as_table
from nerfloom.benchmarks.kernel_errors import measured as errors_of_all
from nerfloom.benchmarks.kernels import Row, measured, on_any_device, table
from nerfloom.comparison.measures import Curve
from nerfloom.comparison.measures import Row as Compared
from nerfloom.comparison.plan import Conditions, Contender, Plan
from nerfloom.geometry.rays import Samples
from nerfloom.kernels import triton_backend
from nerfloom.kernels.compositing.density import distortion, distortion_reference
from nerfloom.kernels.encodings.contraction import contract_to_unit, contract_to_unit_reference
from nerfloom.kernels.histograms.intervals import (
    interval_weights,
    interval_weights_reference,
    proposal_excess,
    proposal_excess_reference,
    resample,
    resample_reference,
)
from nerfloom.registry import load_dataparser, load_method
from nerfloom.testing.scenes import ball_in_a_box, ball_under_a_sky
from nerfloom.training.machine import machine
from nerfloom.training.run import Run
from nerfloom.training.trainer import Trainer

COPIED, EDGE = 2**28, 8192
"""Values copied, and rows of the matrices multiplied, to measure a GPU's limits."""
METHODS = ("instant-ngp", "gaussian-splatting")
"""Methods to train."""
MOMENTS = (2, 5, 15, 60)
"""Seconds of training until the PSNR is reported."""
BINS = 64
"""Intervals per ray."""
SCENES = {"nerfacto": ball_under_a_sky, "instant-ngp": ball_in_a_box}
"""Methods with steps timed as CUDA graphs, and the scene of each."""
SIZE = 200
"""Width of the images of these scenes, pixels."""


@dataclass(frozen=True)
class Part:
    """A part of a benchmark, under a common time limit."""

    name: str
    """Description of the measurement."""
    least: float
    """Minimum remaining seconds to start it."""
    measure: Callable[[float], dict[str, Any]]
    """Function from the remaining seconds to its results, as plain data."""


def in_time(
    parts: Sequence[Part],
    limit: float,
    keep: Callable[[dict[str, Any]], None],
    clock: Callable[[], float] = time.monotonic,
) -> None:
    """Measure parts in order, and skip parts that would take too long.

    Args:
        parts: the parts, most important first.
        limit: total seconds.
        keep: called with all results so far after each part, including skipped ones, so that a later error loses
            nothing.
        clock: seconds since an arbitrary moment.
    """
    start, found, late = clock(), dict[str, Any](), list[str]()
    for part in parts:
        left = limit - (clock() - start)
        if left < part.least:
            say(f"left out: {part.name}; {max(left, 0):.0f} of {limit:.0f} s are left, and it takes {part.least:.0f}")
            late.append(part.name)
        else:
            found |= part.measure(left)
        keep({**found, "left out, too little time": late})


def measured_kernels(device: torch.device, samples: int, repeats: int, seconds: float = math.inf) -> dict[str, Any]:
    """Measure every kernel on a device and print a table; errors come first, because they matter most.

    Args:
        samples: number of samples in a batch.
        repeats: number of runs for medians.
        seconds: time until the start of the last kernel.

    Returns:
        The machine, its limits, the names of kernels that were not timed, and a row for each kernel, as plain data.
    """
    rows, late, start = list[Row](), list[str](), time.monotonic()
    threads = torch.get_num_threads()
    found = errors_of_all(device) if triton_backend.available() else []
    console.print(as_table(found))
    with torch.device(device):
        ceilings = Ceilings.measured(COPIED, EDGE) if device.type == "cuda" else Ceilings.measured()
        for line in ceilings.lines():
            say(f"ceiling: {line}")
        for kernel in chain(on_any_device(samples), along_rays(samples)):  # each frees the inputs of the one before
            if time.monotonic() - start > seconds:
                late.append(kernel.name)
                continue
            say(f"measuring {kernel.name}")
            rows += measured(kernel, ceilings, repeats, 1)
    torch.set_num_threads(threads)
    console.print(table(rows))
    return {
        "machine": machine(device),
        "ceilings": asdict(ceilings),
        "kernels": [_plain(row) for row in rows],
        "kernels not timed": late,
        "errors": [asdict(error) for error in found],
    }


def _plain(row: Row) -> dict[str, Any]:
    share = None if row.at_ceiling is None else row.at_ceiling / row.forward
    return {name: value for name, value in asdict(row).items() if name != "threads"} | {"share of the limit": share}


def along_rays(count: int) -> Iterator[Kernel]:
    """Yield kernels of rays with `BINS` intervals, on torch's default device, with batches of `count` samples."""
    rays = count // BINS
    edges, weights = torch.rand(rays, BINS + 1).sort(-1).values, torch.rand(rays, BINS) / BINS
    starts, offsets = torch.rand(count).cumsum(0), torch.arange(0, rays * BINS + 1, BINS)
    box = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])

    def packed(like: Tensor) -> Samples:
        return Samples(starts[: rays * BINS].to(like), starts[: rays * BINS].to(like) + 0.5, offsets)

    yield of_function(
        "contraction",
        [3 * torch.randn(count, 3)],
        lambda x: contract_to_unit(x, box),
        lambda x: contract_to_unit_reference(x, box.to(x)),
        Work(bytes=4 * 6),
    )
    yield of_function(
        f"distortion, {BINS} samples a ray",
        [torch.rand(rays * BINS)],
        lambda w: distortion(w, packed(w)),
        lambda w: distortion_reference(w, packed(w)),
        Work(bytes=4 * 3),
    )
    yield of_function(
        f"weights of {BINS} intervals",
        [torch.rand(rays, BINS) * 9],
        lambda sigma: interval_weights(sigma, edges),
        lambda sigma: interval_weights_reference(sigma, edges.to(sigma)),
        Work(bytes=4 * 3 * BINS),
        unit="ray",
    )
    yield of_function(
        f"resampling of {BINS} intervals",
        [edges, weights, torch.rand(rays)],
        lambda t, w, shift: resample(t, w, shift, BINS, 1.0, 0.01),
        lambda t, w, shift: resample_reference(t, w, shift, BINS, 1.0, 0.01),
        Work(bytes=4 * 3 * BINS),
        backward=False,
        unit="ray",
    )
    yield of_function(
        f"loss of a proposal of {BINS} intervals",
        [weights.flip(-1) / 2],
        lambda p: proposal_excess(edges, weights, edges, p),
        lambda p: proposal_excess_reference(edges.to(p), weights.to(p), edges.to(p), p),
        Work(bytes=4 * 4 * BINS),
        unit="ray",
    )


def timed_steps(device: torch.device, before: int, steps: int, **settings: Any) -> list[dict[str, Any]]:
    """Time training steps of nerfacto and instant-ngp, unchanged and repeated as CUDA graphs.

    Args:
        before: untimed steps at the beginning, which compile kernels and capture steps.
        steps: number of timed steps.
        settings: settings of the methods other than their defaults.

    Returns:
        A row for each, as plain data: milliseconds per step, number of repeated steps, and the PSNR of batches, which
        should agree.
    """
    return [_timed(method, mode, device, before, steps, settings) for method in SCENES for mode in ("off", "auto")]


def _timed(
    method: str, mode: str, device: torch.device, before: int, steps: int, settings: dict[str, Any]
) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        config = replace(load_method(method).config, vis="none", **settings)
        config = replace(config, machine=replace(config.machine, cuda_graphs=mode))  # type: ignore[arg-type]
        run = Run(method, config, "blender", load_dataparser("blender")(), Path(folder))
        trainer = Trainer.of(run, SCENES[method](SIZE).to(device))
        for _ in range(before):
            trainer.train_step()
        wait_for(device)
        start = time.perf_counter()
        for _ in range(steps):
            report = trainer.train_step()
        wait_for(device)
        milliseconds = (time.perf_counter() - start) / steps * 1e3
    repeated = 0 if trainer.graphs is None else trainer.graphs.repeated
    say(f"{method}, CUDA graphs {mode}: {milliseconds:.2f} ms a step, {repeated} of {before + steps} repeated")
    return {
        "method": method, "CUDA graphs": mode, "ms a step": milliseconds, "steps": before + steps,
        "repeated": repeated, "PSNR of batches, dB": report.psnr,
    }  # fmt: skip


def gpu_plan(data: Path | None, seconds: float, folder: Path) -> Plan:
    """Return the plan of `seconds` of training per method, on `data` or the embedded scene, into `folder`."""
    path = None if data is None else str(data.resolve())
    conditions = Conditions(path, max_seconds=seconds, device_type="cuda", max_eval_images=20)
    return Plan(tuple(map(Contender.of, METHODS)), conditions, 1, folder.resolve())


def reached(rows: Sequence[Compared]) -> list[dict[str, Any]]:
    """Return the methods' results, the `rows` of the comparison's table, as plain data."""
    return [
        {
            "method": run.method,
            "PSNR, dB": run.psnr,
            "seconds": run.seconds,
            "steps": run.steps,
            "rays per second": run.rays_per_second,
            "PSNR after seconds, dB": {str(moment): psnr_at(run.curve, moment) for moment in MOMENTS},
        }
        for row in rows
        for run in row.runs
    ] + [{"method": row.label, "failures": [str(failure) for failure in row.failures]} for row in rows if row.failures]


def psnr_at(curve: Curve, seconds: float) -> float | None:
    """Return the PSNR, dB, of the last point (seconds, PSNR) of a `curve` within `seconds`; None before the first."""
    return next((psnr for time, psnr in reversed(curve) if time <= seconds), None)
