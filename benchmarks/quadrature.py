"""Error of colours against evaluations of the field, for every sampler, on scenes with closed forms.

Rays are random, from around the scene, over white. `sweep` measures the error for increasing numbers of samples, and
`costs` computes the evaluations needed for a given error. `skipping` measures, on many more rays, how skipping empty
cells and ending rays early change colours. Ending rays has an error bound, and `Skip.kept` states whether it holds.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from rich.table import Table
from torch import Tensor

from benchmarks.closed_forms import ClosedForm, scenes
from benchmarks.error_curves import Curve, draw, evaluations_needed
from benchmarks.sampling import (
    WHITE,
    Renderer,
    filled_grid,
    fitted_proposals,
    full_grid,
    marched,
    random_rays,
    renderers,
)
from nerfloom.base.console import console, say
from nerfloom.base.device import seed_step, stream_seed
from nerfloom.base.json_files import finite_or_null
from nerfloom.cli.bench_results import write_results
from nerfloom.geometry.rays import Rays
from nerfloom.samplers.occupancy import OccupancySampler
from nerfloom.samplers.proposal import ProposalSampler
from nerfloom.training.machine import machine

TARGETS = (1e-2, 1e-3, 1e-4)
"""The number of evaluations is reported for these mean errors."""
THRESHOLDS = (1e-1, 1e-2, 1e-3, 1e-4)
"""Transmittances where rays end; each is also the bound of the error."""
STEPS = 512
"""Steps along the box's diagonal in measurements of skipping; the framework's default."""
RAYS_AT_ONCE, SKIPPING_RAYS_AT_ONCE = 512, 4096
"""Rays per batch in the sweep, and in measurements of skipping."""


@dataclass(frozen=True)
class Sizes:
    """Size of the measurement."""

    counts: tuple[int, ...] = (8, 16, 32, 64, 128, 256, 512)
    """Counts of the sweep; each sampler multiplies them (`sampling.renderers`)."""
    rays: int = 4096
    """Number of rays at each point of the sweep."""
    skipping_rays: int = 100_000
    """Number of rays for measurements of skipping."""
    fit_steps: int = 400
    """Training steps of the proposals."""
    grid_resolution: int = 128
    """Cells per axis of the occupancy grid."""


FULL = Sizes()
QUICK = Sizes(counts=(8, 16, 32, 64), rays=1024, skipping_rays=10_000, fit_steps=150, grid_resolution=64)


@dataclass(frozen=True)
class Row:
    """A point of the sweep: the errors of `sampler` with `count` on `scene`."""

    scene: str
    sampler: str
    count: int
    evaluations: float
    """Evaluations of the field per ray."""
    coarse_evaluations: float
    """Evaluations of a coarse field or of proposals per ray."""
    mean_error: float
    """Mean absolute error over rays and colour channels."""
    half_width: float
    """Half width of the mean's 95 % confidence interval."""
    max_error: float
    """Maximum absolute error of a colour channel."""


@dataclass(frozen=True)
class Skip:
    """Differences of colours with and without skipping samples."""

    scene: str
    """Name of the scene."""
    skipped: str
    """Kind of the skipped samples: in empty cells, or hidden."""
    bound: float | None
    """Bound of the maximum difference; None if there is none."""
    mean_error: float
    """Mean absolute difference over rays and colour channels."""
    max_error: float
    """Maximum absolute difference of a colour channel."""
    kept: bool | None
    """Whether the maximum difference is within the bound; None without a bound."""
    evaluations: float
    """Evaluations of the field per ray."""
    evaluations_without: float
    """Evaluations of the field per ray without skipping."""


def main(output: Path, plots: Path | None = None, quick: bool = False, seed: int = 0) -> dict[str, Any]:
    """Measure every sampler on every scene, and print and write the results.

    Args:
        output: JSON file to write.
        plots: folder for a plot of each scene's curves; no plots if None.
        quick: whether to use fewer rays, counts and steps.
        seed: random seed of rays, jitter and proposals.

    Returns:
        The content of the JSON file.
    """
    sizes = QUICK if quick else FULL
    rows: list[Row] = []
    skips: list[Skip] = []
    fits: dict[str, float] = {}
    for name, scene in scenes().items():
        start = time.perf_counter()
        proposals, fits[name] = fitted_proposals(scene, sizes.fit_steps, seed)
        grids = functools.cache(partial(filled_grid, scene, sizes.grid_resolution, seed))
        rows += sweep(name, scene, proposals, grids, sizes, seed)
        skips += skipping(name, scene, grids(STEPS), sizes.skipping_rays, seed)
        say(f"{name}: {time.perf_counter() - start:.0f} s, including {fits[name]:.0f} s for fitting proposals")
    needed = costs(rows)
    console.print(cost_table(needed))
    console.print(skip_table(skips))
    content = {
        "machine": machine(),
        "seed": seed,
        "sizes": asdict(sizes),
        "seconds of fitting proposals": fits,
        "rows": [asdict(row) for row in rows],
        "evaluations needed": needed,
        "skipping": [asdict(skip) for skip in skips],
    }
    write_results(output, finite_or_null(content))
    if plots is not None:
        for path in draw(curves(rows), plots):
            say(f"drawn: {path}")
    return content


# -- the sweep ----------------------------------------------------------------------------------------------------


@torch.no_grad()
def sweep(
    name: str,
    scene: ClosedForm,
    proposals: ProposalSampler,
    grids: Callable[[int], OccupancySampler],
    sizes: Sizes,
    seed: int,
) -> list[Row]:
    """Measure the errors of every sampler on a scene, all on the same rays.

    Args:
        name: name of the scene.
        scene: the scene.
        proposals, grids: as in `sampling.renderers`.
        sizes: size of the measurement.
        seed: random seed of rays and jitter.
    """
    rays = random_rays(sizes.rays, seed)
    truth = torch.cat([scene.truth(part, WHITE).color for part in _parts(rays, RAYS_AT_ONCE)])
    rows = []
    for count in sizes.counts:
        for sampler, render in renderers(scene, proposals, grids, count).items():
            seed_step(seed, count)
            rows.append(measured(name, sampler, count, render, rays, truth))
    return rows


def measured(scene: str, sampler: str, count: int, render: Renderer, rays: Rays, truth: Tensor) -> Row:
    """Measure the errors of rendered colours.

    Args:
        scene, sampler, count: as in `Row`.
        render: the renderer.
        rays: R rays.
        truth: (R, 3) float64 true colours.
    """
    pictures = [render(part) for part in _parts(rays, RAYS_AT_ONCE)]
    errors = (torch.cat([picture.color for picture in pictures]).double() - truth).abs()
    ray_errors = errors.mean(-1)
    return Row(
        scene,
        sampler,
        count,
        evaluations=sum(picture.evaluations for picture in pictures) / len(rays),
        coarse_evaluations=sum(picture.coarse_evaluations for picture in pictures) / len(rays),
        mean_error=ray_errors.mean().item(),
        half_width=1.96 * ray_errors.std().item() / math.sqrt(len(rays)),
        max_error=errors.max().item(),
    )


def _parts(rays: Rays, size: int) -> list[Rays]:
    return [rays[start : start + size] for start in range(0, len(rays), size)]


def curves(rows: Iterable[Row]) -> dict[str, dict[str, Curve]]:
    """Group the `rows` of a sweep into curves by scene and sampler."""
    by_scene: dict[str, dict[str, Curve]] = {}
    for row in rows:
        curve = by_scene.setdefault(row.scene, {}).setdefault(row.sampler, Curve([], [], [], []))
        curve.evaluations.append(row.evaluations)
        curve.in_all.append(row.evaluations + row.coarse_evaluations)
        curve.errors.append(row.mean_error)
        curve.half_widths.append(row.half_width)
    return by_scene


def costs(rows: Iterable[Row]) -> list[dict[str, Any]]:
    """Return the evaluations per ray for each of `TARGETS`, from `rows` of a sweep; None if a target is not reached."""
    return [
        {
            "scene": scene,
            "sampler": sampler,
            "mean_error": target,
            "evaluations": evaluations_needed(curve.evaluations, curve.errors, target),
            "in_all": evaluations_needed(curve.in_all, curve.errors, target),
        }
        for scene, by_sampler in curves(rows).items()
        for sampler, curve in by_sampler.items()
        for target in TARGETS
    ]


# -- skipping -----------------------------------------------------------------------------------------------------


@torch.no_grad()
def skipping(name: str, scene: ClosedForm, grid: OccupancySampler, num_rays: int, seed: int) -> list[Skip]:
    """Measure the effect of an occupancy grid on colours, and of ending rays at each of `THRESHOLDS` with it.

    Args:
        name: name of the scene.
        scene: the scene.
        grid: a filled grid of `STEPS` steps.
        num_rays: number of rays.
        seed: random seed of the rays.
    """
    everything, cells = partial(marched, scene, full_grid(STEPS), 0.0), partial(marched, scene, grid, 0.0)
    skips = [changed(name, "empty cells", None, cells, everything, num_rays, seed)]
    for threshold in THRESHOLDS:
        stopped = partial(marched, scene, grid, threshold)
        skips.append(changed(name, "hidden", threshold, stopped, cells, num_rays, seed))
    return skips


def changed(
    scene: str, skipped: str, bound: float | None, render: Renderer, without: Renderer, num_rays: int, seed: int
) -> Skip:
    """Measure the differences between two renderers in the colours of random rays, and their evaluations.

    A NaN among the differences makes the maximum NaN, which is not within any bound.

    Args:
        scene, skipped, bound: as in `Skip`.
        render: renderer with skipping.
        without: renderer without skipping.
        num_rays: number of rays.
        seed: random seed of the rays.
    """
    differences, evaluations, evaluations_without = [], 0, 0
    for start in range(0, num_rays, SKIPPING_RAYS_AT_ONCE):
        rays = random_rays(min(SKIPPING_RAYS_AT_ONCE, num_rays - start), stream_seed(seed, start))
        picture, full = render(rays), without(rays)
        differences.append((picture.color - full.color).abs())
        evaluations += picture.evaluations
        evaluations_without += full.evaluations
    difference = torch.cat(differences)
    largest = difference.max().item()
    kept = None if bound is None else largest <= bound
    mean = difference.double().mean().item()
    return Skip(scene, skipped, bound, mean, largest, kept, evaluations / num_rays, evaluations_without / num_rays)


# -- tables -------------------------------------------------------------------------------------------------------


def cost_table(needed: list[dict[str, Any]]) -> Table:
    """Return a table of `needed`, from `costs`: evaluations of the field, and with coarse ones in brackets."""
    table = Table(title="evaluations a ray for a mean error of colour (with coarse ones)", title_justify="left")
    for heading in ("scene", "sampler", *(f"{target:.0e}" for target in TARGETS)):
        table.add_column(heading, justify="left" if heading in ("scene", "sampler") else "right")
    for first in range(0, len(needed), len(TARGETS)):
        cells = needed[first : first + len(TARGETS)]
        table.add_row(cells[0]["scene"], cells[0]["sampler"], *map(_cost, cells))
    return table


def _cost(cell: dict[str, Any]) -> str:
    if cell["evaluations"] is None:
        return "not met"
    own, in_all = (f"{value:.1f}" if value < 10 else f"{value:.0f}" for value in (cell["evaluations"], cell["in_all"]))
    return own if own == in_all else f"{own} ({in_all})"


def skip_table(skips: list[Skip]) -> Table:
    """Return a table of `skips`: differences of colours, and saved evaluations."""
    table = Table(title="effect of skipping on colours, and saved evaluations", title_justify="left")
    for heading in ("scene", "skipped", "bound", "largest", "mean", "kept", "saved"):
        table.add_column(heading, justify="left" if heading in ("scene", "skipped") else "right")
    for skip in skips:
        saved = 1 - skip.evaluations / max(skip.evaluations_without, 1e-9)
        bound, kept = ("none", "") if skip.bound is None else (f"{skip.bound:.0e}", "yes" if skip.kept else "NO")
        figures = bound, f"{skip.max_error:.1e}", f"{skip.mean_error:.1e}", kept, f"{saved:.1%}"
        table.add_row(skip.scene, skip.skipped, *figures)
    return table
