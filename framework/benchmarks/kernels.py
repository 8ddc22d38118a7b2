"""Time per sample and error of each compiled kernel against its torch reference, in one process, in alternating runs.

Times are medians; the speed-up is the median of the ratios of neighbouring runs, which a machine whose speed drifts
disturbs least. NERFLOOM_KERNELS=avx2 in the environment forces that variant.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from statistics import median
from typing import Any

import torch
from torch import Tensor

from framework.benchmarks.ceilings import ceilings
from framework.benchmarks.plane_lookups import layouts, plane_lookup
from framework.cameras import Cameras
from framework.console import say
from framework.errors import ConfigError
from framework.kernels import native
from framework.kernels.adam import sparse_adam, sparse_adam_reference
from framework.kernels.compositing import composite, composite_reference
from framework.kernels.frequency import frequency_encoding, frequency_encoding_reference
from framework.kernels.hash_grid import HashGridLayout, hash_grid, hash_grid_reference
from framework.kernels.march import March, Occupancy, ReferenceMarch
from framework.kernels.mlp import mlp, mlp_reference
from framework.kernels.spherical_harmonics import spherical_harmonics, spherical_harmonics_reference
from framework.machine import machine
from framework.rays import Rays, Samples

BOX = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])


@dataclass(frozen=True)
class Row:
    """One kernel: run(function, inputs) for the compiled and the reference function on the same inputs."""

    name: str
    samples: int
    inputs: list[Tensor]
    compiled: Callable[..., Tensor]
    reference: Callable[..., Tensor]
    differentiable: bool = True


def rays_and_positions(count: int) -> tuple[Rays, Tensor]:
    """Rays through the unit box, 16 points close together on each: what a trained scene's samples look like."""
    origins = torch.nn.functional.normalize(torch.randn(count // 16, 3), dim=-1) * 2 + 0.5
    directions = torch.nn.functional.normalize(torch.rand(count // 16, 3) - origins, dim=-1)
    rays = Rays(origins, directions, torch.zeros(count // 16), torch.full((count // 16,), 9.0))
    t = (2 + torch.rand(count // 16, 1) - 0.5) + torch.arange(16) * 0.003
    positions = origins[:, None] + t[..., None] * directions[:, None]
    return rays, positions.reshape(-1, 3).clamp(0, 1)


def rows(count: int) -> Iterator[Row]:
    """Every kernel that has a value per sample."""
    torch.manual_seed(0)
    _, positions = rays_and_positions(count)
    for log2 in (15, 17, 19):
        layout = HashGridLayout.build(16, 16, 1024, log2)
        table = torch.randn(layout.num_entries, 2)
        yield Row(
            f"hash grid, 16 levels x 2, tables of 2^{log2}",
            count,
            [positions, table],
            lambda x, t, layout=layout: hash_grid(x.detach(), t, layout),
            lambda x, t, layout=layout: hash_grid_reference(x.detach(), t, layout),
        )
    layout = HashGridLayout.build(16, 16, 1024, 17)
    yield Row(
        "hash grid, gradient of positions too, 2^17",
        count,
        [positions, torch.randn(layout.num_entries, 2)],
        lambda x, t: hash_grid(x, t, layout),
        lambda x, t: hash_grid_reference(x, t, layout),
    )
    for name, widths, activation in (("32-64-16", (32, 64, 16), "none"), ("32-64-64-3", (32, 64, 64, 3), "sigmoid")):
        inputs = [torch.randn(count, widths[0])]
        inputs += [torch.randn(b, a) * (2 / a) ** 0.5 for a, b in pairwise(widths)]
        for kind in ("float32", "bfloat16") if native.has("mlp_forward_bf16") else ("float32",):
            yield Row(
                f"network {name}, {kind}",
                count,
                inputs,
                lambda x, *w, a=activation, k=kind: _autocast(k, lambda: mlp([x], w, a)),
                lambda x, *w, a=activation: mlp_reference([x], w, a),
            )
    offsets = torch.arange(0, count + 1, 16)
    starts = (torch.rand(count // 16, 1) + torch.arange(16) * 0.01).reshape(-1)
    samples = Samples(starts, starts + 0.01, offsets)
    background, fars = torch.rand(count // 16, 3), torch.full((count // 16,), 9.0)
    yield Row(
        "compositing, 16 samples a ray",
        count,
        [torch.rand(count) * 50, torch.rand(count, 3)],
        lambda s, c: composite(samples, s, c, background, fars).color,
        lambda s, c: composite_reference(_like(samples, s), s, c, background.to(s), fars.to(s)).color,
    )
    yield Row(
        "frequency encoding, 10 octaves of 3",
        count,
        [torch.rand(count, 3)],
        lambda x: frequency_encoding(x, 10),
        lambda x: frequency_encoding_reference(x, 10),
    )
    directions = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1)
    yield Row(
        "spherical harmonics, 4 bands",
        count,
        [directions],
        lambda d: spherical_harmonics(d.detach()),
        lambda d: spherical_harmonics_reference(d.detach()),
        differentiable=False,
    )


def _autocast(kind: str, run: Callable[[], Tensor]) -> Tensor:
    with torch.autocast("cpu", torch.bfloat16, enabled=kind == "bfloat16"):
        return run()


def _like(samples: Samples, values: Tensor) -> Samples:
    return Samples(samples.t_starts.to(values), samples.t_ends.to(values), samples.offsets)


def timed(row: Row, repeats: int, all_threads: int) -> dict[str, object]:
    """Forward alone and forward with backward, compiled and reference in turn, on 1 thread and on all."""
    out: dict[str, object] = {"kernel": row.name, "samples": row.samples}
    for threads in sorted({1, all_threads}):
        torch.set_num_threads(threads)
        times: dict[str, list[float]] = {}
        for repeat in range(repeats + 1):
            for name, function in (("compiled", row.compiled), ("reference", row.reference)):
                leaves = [t.clone().requires_grad_(row.differentiable) for t in row.inputs]
                start = time.perf_counter()
                value = function(*leaves)
                middle = time.perf_counter()
                if row.differentiable:
                    value.sum().backward()
                end = time.perf_counter()
                if repeat:  # the first is a warm-up
                    times.setdefault(f"{name} forward", []).append(middle - start)
                    times.setdefault(f"{name} backward", []).append(end - middle)
        for name, spent in times.items():
            if row.differentiable or name.endswith("forward"):
                out[f"{name}, ns per sample, {threads} threads"] = round(median(spent) / row.samples * 1e9, 1)
        slow = [a + b for a, b in zip(times["reference forward"], times["reference backward"], strict=True)]
        fast = [a + b for a, b in zip(times["compiled forward"], times["compiled backward"], strict=True)]
        out[f"speed-up, {threads} threads"] = round(median(a / b for a, b in zip(slow, fast, strict=True)), 1)
    out |= errors(row)
    return out


def errors(row: Row) -> dict[str, float]:
    """Errors of the value and of all gradients against float64: the largest over the largest, and root mean squares.

    The largest error of a gradient tells little where it jumps: at a cell's face, and where a ReLU switches.
    """
    found = []
    for function, kind in ((row.compiled, torch.float32), (row.reference, torch.float64)):
        leaves = [t.detach().to(kind, copy=True).requires_grad_(row.differentiable) for t in row.inputs]
        value = function(*leaves)
        if row.differentiable:
            (value * torch.linspace(-1, 1, value.numel()).view_as(value).to(kind)).sum().backward()
        found.append([value.detach(), *(leaf.grad for leaf in leaves if leaf.grad is not None)])
    relative = [
        ((a.double() - b).abs().max() / b.abs().max()).item() for a, b in zip(*found, strict=True) if b.abs().max() > 0
    ]
    squares = [
        ((a.double() - b).square().mean() / b.square().mean()).sqrt().item()
        for a, b in zip(*found, strict=True)
        if b.abs().max() > 0
    ]
    return {
        "error of the value": relative[0],
        "largest error of a gradient": max(relative[1:], default=0.0),
        "root mean square error of a gradient": max(squares[1:], default=0.0),
    }


def marching(repeats: int) -> dict[str, object]:
    """All samples of 8192 rays through a grid of which 3 % are occupied."""
    torch.manual_seed(0)
    rays, _ = rays_and_positions(8192 * 16)
    centers = (torch.cartesian_prod(*[torch.arange(128)] * 3) + 0.5) / 128 - 0.5
    grid = Occupancy.of((centers.norm(dim=-1) - 0.3).abs() < 0.015, BOX, 128)
    times: dict[str, list[float]] = {"compiled": [], "reference": []}
    found = 0
    for repeat in range(repeats + 1):
        for name, kind in (("compiled", March), ("reference", ReferenceMarch)):
            start = time.perf_counter()
            march, found = kind(rays, grid, 3**0.5 / 512, 0.0, None, 1e-4), 0
            while (wave := march.wave(16)) is not None:
                march.advance(torch.zeros_like(wave.t_starts))
                found += len(wave.t_starts)
            if repeat:
                times[name].append(time.perf_counter() - start)
    return {
        "kernel": f"marching, {len(rays)} rays, {found} samples, ns per ray",
        **{name: round(median(spent) / len(rays) * 1e9) for name, spent in times.items()},
        "speed-up": round(median(r / c for c, r in zip(times["compiled"], times["reference"], strict=True)), 1),
    }


def updating(repeats: int) -> dict[str, object]:
    """Sparse Adam on a table of which half of the entries have a gradient, ns per updated entry."""
    torch.manual_seed(0)
    entries = 2**19
    grad = torch.randn(entries, 2) * (torch.rand(entries, 1) < 0.5)
    times: dict[str, list[float]] = {"compiled": [], "reference": []}
    updated = 0
    for name, update in (("compiled", sparse_adam), ("reference", sparse_adam_reference)):
        mean, square, uses = torch.zeros(entries, 2), torch.zeros(entries, 2), torch.zeros(entries)
        values = torch.randn(entries, 2)
        for repeat in range(repeats + 1):
            mine = grad.clone()
            start = time.perf_counter()
            updated = update(values, mine, mean, square, uses, 1e-2, (0.9, 0.95), 1e-15)
            if repeat:
                times[name].append(time.perf_counter() - start)
    return {
        "kernel": f"sparse Adam, {updated} of {entries} entries x 2, ns per updated entry",
        **{name: round(median(spent) / updated * 1e9, 2) for name, spent in times.items()},
        "speed-up": round(median(times["reference"]) / median(times["compiled"]), 1),
    }


def ray_generation(model: str, lens: list[float], repeats: int) -> dict[str, object]:
    """Rays through 8192 pixels of photographs of 1600 x 1200 by a lens of the usual strength, ns per ray."""
    torch.manual_seed(0)
    focal, cx, cy, width, height = (torch.tensor([value]) for value in (1100.0, 800.0, 600.0, 1600, 1200))
    bent = torch.tensor([lens]) if lens else None
    cameras = Cameras(torch.eye(4)[None, :3], focal, focal, cx, cy, width, height, model, bent)
    flat = torch.randint(1600 * 1200, (8192,))
    times: dict[str, list[float]] = {"compiled": [], "reference": []}
    for repeat in range(repeats + 1):
        for name, make in (("compiled", cameras.pixel_rays), ("reference", cameras.pixel_rays_reference)):
            start = time.perf_counter()
            make(flat, 0.1, 9.0)
            if repeat:
                times[name].append(time.perf_counter() - start)
    return {
        "kernel": f"rays of {model} cameras, ns per ray",
        **{name: round(median(spent) / len(flat) * 1e9, 1) for name, spent in times.items()},
        "speed-up": round(median(r / c for c, r in zip(times["compiled"], times["reference"], strict=True)), 1),
    }


LENSES: tuple[tuple[str, list[float]], ...] = (
    ("pinhole", []),
    ("opencv", [-0.28, 0.09, 6e-4, -9e-4, 0, 0, 0, 0, 0]),
    ("fisheye", [0.04, -0.01, 3e-3, -6e-4]),
)
"""Models, and coefficients of the usual strength."""


def measure(samples: int, repeats: int) -> dict[str, Any]:
    """Every kernel's times and errors, the machine, and its ceilings, measured now; rows are printed as they come.

    Args:
        samples: in a batch.
        repeats: of which medians are taken.
    Raises: ConfigError where there are no compiled kernels.
    """
    if not native.available():
        raise ConfigError("there are no compiled kernels to measure; reinstall nerfloom with a C++ compiler at hand")
    threads = torch.get_num_threads()
    jobs: list[Callable[[], dict[str, object]]] = [
        lambda row=row: timed(row, repeats, threads)  # type: ignore[misc]
        for row in rows(samples)
    ]
    jobs += [lambda: marching(repeats), lambda: updating(repeats)]
    jobs += [lambda m=model, c=lens: ray_generation(m, c, repeats) for model, lens in LENSES]  # type: ignore[misc]
    jobs += [
        lambda n=name, p=layout, f=features: plane_lookup(n, p, f, samples, repeats, threads)  # type: ignore[misc]
        for name, layout, features in layouts()
    ]
    limits, table = ceilings(), []
    say(str(limits))
    for job in jobs:
        torch.set_num_threads(threads)
        table.append(job())
        say(str(table[-1]))
    torch.set_num_threads(threads)
    return {"machine": machine(), "ceilings": limits, "rows": table}
