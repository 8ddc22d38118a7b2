"""The lines of the tables of measurements in docs/results, by the name of a table."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parents[1] / "results"
Lines = Iterator[list[str]]
"""The cells of each line below the headings."""


def _content(name: str) -> Any:
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def _digits(value: float | None, border: float = 100) -> str:
    """Return a number with a digit behind the point below `border`, nothing if there is none."""
    return "" if value is None else f"{value:.1f}" if value < border else f"{value:.0f}"


def _error(value: float | None) -> str:
    return "" if value is None else f"{value:.0e}" if value else "0"


def _kernels() -> Lines:
    for row in _content("kernels-avx512_bf16")["rows"]:
        if row["threads"] == 2:
            both = row["reference_forward"] + (row["reference_backward"] or 0)
            times = map(_digits, (row["forward"], row["at_ceiling"], row["backward"], both))
            whose = [row["errors"] or {}, row["reference_errors"] or {}]
            pairs = (errors.get(kind) for kind in ("value", "gradient") for errors in whose)
            unit = f"{'an' if row['unit'][0] in 'aeiou' else 'a'} {row['unit']}"
            yield [f"{row['kernel']}, {unit}", *times, f"{row['speed_up']:.1f}", *map(_error, pairs)]


def _gpu() -> Lines:
    for row in _content("gpu-lego")["kernels"]:
        both = row["reference_forward"] + (row["reference_backward"] or 0)
        backward = "" if row["backward"] is None else f"{row['backward']:.1f}"
        cells = [row["kernel"], row["unit"], f"{row['forward']:.1f}", backward, f"{both:.0f}"]
        yield [*cells, f"{row['speed_up']:.1f}"]


def _interpreter() -> Lines:
    errors = _content("gpu-interpreter")["errors"]
    for kernel in dict.fromkeys(row["kernel"] for row in errors):
        kinds = {row["kind"]: row for row in errors if row["kernel"] == kernel}
        pairs = ([kinds[kind]["value"], kinds[kind].get("gradient")] for kind in ("random", "extreme"))
        cells = [", ".join(filter(None, map(_error, pair))) for pair in pairs]
        yield [kernel, *cells, _error(kinds["empty"]["value"])]


def _operations() -> Lines:
    for row in _content("operations")["rows"]:
        yield [row["method"], f"{row['operations']:,}", f"{row['waits']:g}"]


def _stress(*methods: str) -> Lines:
    found = {row["method"].split()[0]: {v["name"]: v for v in row["verdicts"]} for row in _content("stress")["methods"]}
    for name in found[methods[0]]:
        verdicts = [found[method][name] for method in methods]
        yield [name, *(_verdict(verdict) for verdict in verdicts)]


def _verdict(verdict: dict[str, Any]) -> str:
    if verdict["name"] == "plain":
        return f"{verdict['outcome']} {verdict['psnr']:.1f} dB"
    return verdict["outcome"] + ("" if verdict["lost"] is None else f" {0.0 - verdict['lost']:+.1f}")


def _quadrature() -> Lines:
    needed = _content("quadrature")["evaluations needed"]
    for scene, sampler in dict.fromkeys((row["scene"], row["sampler"]) for row in needed):
        yield [scene, sampler, *(_needed(row) for row in needed if (row["scene"], row["sampler"]) == (scene, sampler))]


def _needed(row: dict[str, Any]) -> str:
    if row["evaluations"] is None:
        return "–"
    own, in_all = (_digits(row[key], 10) for key in ("evaluations", "in_all"))
    return own if own == in_all else f"{own} ({in_all})"


def _skipped(what: str) -> Lines:
    for row in _content("quadrature")["skipping"]:
        if row["skipped"] == what:
            saved = f"{100 * (1 - row['evaluations'] / row['evaluations_without']):.1f}%"
            errors = [f"{row['mean_error']:.1e}", f"{row['max_error']:.1e}"]
            bound = [] if row["bound"] is None else [f"{row['bound']:.0e}"]
            yield [row["scene"], *bound, *(errors[::-1] if bound else errors), saved]


def _viewer() -> Lines:
    for row in _content("viewer")["pictures"]:
        stride = f", one ray for {row['stride']}x{row['stride']} pixels while it moves" if row["stride"] > 1 else ""
        seconds = [f"{row['first']:.2f}", f"{1000 * row['coarse']:.0f}", f"{1000 * row['slowest']:.0f}"]
        finished = f"{row['finished']:.2g}"
        name, size = f"{row['run']}, `{row['method']}`{stride}", f"{row['width']}x{row['height']}"
        yield [name, size, *seconds, f"{row['per_second']:.0f}", finished]


def _processes() -> Lines:
    for row in _content("processes-lego")["runs"]:
        seconds = ", ".join(f"{row[f'seconds to {level} dB']:.1f}" for level in (24, 26, 28))
        yield [row["kind"], f"{row['steps']:,}", seconds, f"{row['PSNR of test views, dB']:.2f} dB"]


def _methods(data: str) -> Lines:
    for row in _content(f"methods-{data}")["runs"]:
        rates = [f"{row['steps']:,}", f"{row['rays_per_second']:,.0f}", f"{row['render_seconds']:.2f}"]
        sizes = [f"{row['peak_memory_bytes'] / 2**30:.2f}", f"{row['parameters']:,}"]
        yield [f"`{row['label']}`", f"{row['psnr']:.2f}", f"{row['ssim']:.4f}", *rates, *sizes]


def _levels(*levels: int) -> Lines:
    for row in _content("methods-lego")["runs"]:
        times = (row["seconds_to"].get(str(level)) for level in levels)
        yield [f"`{row['label']}`", *("–" if time is None else f"{time:.1f}" for time in times)]


def _curves() -> Lines:
    for row in _content("curves-lego")["methods"]:
        yield [f"`{row['method']}`", *(f"{point['PSNR, dB']:.2f}" for point in row["points"])]


def _meshes() -> Lines:
    for scene, run in _content("meshes")["rows"].items():
        for row in run["rows"]:
            seconds = [f"{row[key]:.1f}" for key in ("seconds", "CPU seconds")]
            sizes = [f"{row[key]:,}" for key in ("peak memory, MB", "faces")]
            closed = "yes" if row["watertight"] else "no"
            yield [scene, f"{row['export']} of {run['method']}", f"{row['resolution']}", *seconds, *sizes, closed]


def _mesh_distances() -> Lines:
    ways = ("mesh to surface", "surface to mesh")
    for row in _content("meshes")["rows"]["procedural"]["rows"]:
        cells = [row["export"], f"{row['resolution']}"]
        for seen, chamfer in (("", "chamfer, scene units"), ("seen ", "chamfer of what is seen, scene units")):
            cells += [f"{row[seen + way]['mean']:.4f}, {row[seen + way]['median']:.4f}" for way in ways]
            cells.append(f"{row[chamfer]:.4f}")
        yield cells


TABLES: dict[str, Callable[[], Lines]] = {
    "curves": _curves,
    "levels": lambda: _levels(*range(20, 36, 2)),
    "mesh-distances": _mesh_distances,
    "meshes": _meshes,
    "methods-lego": lambda: _methods("lego"),
    "methods-procedural": lambda: _methods("procedural"),
    "processes": _processes,
    "viewer": _viewer,
    "kernels": _kernels,
    "gpu": _gpu,
    "interpreter": _interpreter,
    "operations": _operations,
    "stress": lambda: _stress(
        "instant-ngp", "nerfacto", "kplanes", "tensorf", "vanilla-nerf", "dnerf", "gaussian-splatting"
    ),
    "stress-cones": lambda: _stress("zip-nerf", "mip-nerf", "mip-nerf-360", "nerf-plus-plus", "pixel-nerf"),
    "quadrature": _quadrature,
    "empty-cells": lambda: _skipped("empty cells"),
    "hidden": lambda: _skipped("hidden"),
}
