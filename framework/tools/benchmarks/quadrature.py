"""How far a pixel is off for how many evaluations of the field: every sampler, on scenes known in closed form.

Rays are random, from around the scene, over white. `sweep` measures the colour's error as a sampler's count grows, and
`costs` says how many evaluations an error takes. `skipping` measures what it changes to pass over empty cells, and to
end rays early, on many more rays: for the latter a bound is stated, and `Skip.kept` says whether it holds.
"""

from __future__ import annotations

import functools
import json
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

from framework.base.console import console, say
from framework.base.device import seed_step, stream_seed
from framework.geometry.rays import Rays
from framework.samplers.occupancy import OccupancySampler
from framework.samplers.proposal import ProposalSampler
from framework.tools.benchmarks.closed_forms import ClosedForm, scenes
from framework.tools.benchmarks.curves import Curve, draw, evaluations_needed
from framework.tools.benchmarks.sampling import (
    WHITE,
    Renderer,
    filled_grid,
    fitted_proposals,
    full_grid,
    marched,
    random_rays,
    renderers,
)
from framework.training.machine import machine

TARGETS = (1e-2, 1e-3, 1e-4)
"""Mean errors whose cost is told."""
THRESHOLDS = (1e-1, 1e-2, 1e-3, 1e-4)
"""Transmittances at which rays are ended, each the stated bound of the error that this makes."""
STEPS = 512
"""Along the box's diagonal where skipping is measured: the framework's own."""
RAYS_AT_ONCE, SKIPPING_RAYS_AT_ONCE = 512, 4096


@dataclass(frozen=True)
class Sizes:
    """How much is measured."""

    counts: tuple[int, ...] = (8, 16, 32, 64, 128, 256, 512)
    """The sweep; what a count means is the sampler's (`sampling.renderers`)."""
    rays: int = 4096
    """At each point of the sweep."""
    skipping_rays: int = 100_000
    """On which skipping is measured."""
    fit_steps: int = 400
    """In which proposals learn a scene."""
    grid_resolution: int = 128
    """Cells along an axis of the occupancy grid."""


FULL = Sizes()
QUICK = Sizes(counts=(8, 16, 32, 64), rays=1024, skipping_rays=10_000, fit_steps=150, grid_resolution=64)


@dataclass(frozen=True)
class Row:
    """One point of the sweep."""

    scene: str
    sampler: str
    count: int
    evaluations: float
    """Of the field, a ray."""
    coarse_evaluations: float
    """Of a coarse field or of proposals, which say where to look, a ray."""
    mean_error: float
    """Absolute, over rays and colour channels."""
    half_width: float
    """Of the mean's 95 % interval, for rays are random, and jittered places too."""
    max_error: float


@dataclass(frozen=True)
class Skip:
    """What skipping changes."""

    scene: str
    skipped: str
    """Empty cells, or what is hidden."""
    bound: float | None
    """Of the largest error, as stated; None where nothing is."""
    mean_error: float
    """Absolute difference to the same steps without skipping, over rays and colour channels."""
    max_error: float
    kept: bool | None
    """Whether the largest error is within the bound."""
    evaluations: float
    """Of the field, a ray."""
    evaluations_without: float
    """Without skipping."""


def main(output: Path, plots: Path | None = None, quick: bool = False, seed: int = 0) -> dict[str, Any]:
    """Measure every sampler on every scene, print what was found, and write it down.

    Args:
        output: the JSON.
        plots: folder for a picture of each scene's curves; none if None.
        quick: fewer rays, counts and steps: sooner done, and rougher.
        seed: of rays, jitter and the proposals' tables.
    Returns: what the JSON holds.
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
        say(f"{name}: {time.perf_counter() - start:.0f} s, of which fitting proposals took {fits[name]:.0f} s")
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
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(json.dumps(content, indent=2) + "\n")
    say(f"written to {output}")
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
    """Every sampler's errors on a scene, all on the same rays; `proposals` and `grids` as for `sampling.renderers`."""
    rays = random_rays(sizes.rays, seed)
    truth = torch.cat([scene.truth(part, WHITE).color for part in _parts(rays, RAYS_AT_ONCE)])
    rows = []
    for count in sizes.counts:
        for sampler, render in renderers(scene, proposals, grids, count).items():
            seed_step(seed, count)
            rows.append(measured(name, sampler, count, render, rays, truth))
    return rows


def measured(scene: str, sampler: str, count: int, render: Renderer, rays: Rays, truth: Tensor) -> Row:
    """The error of a renderer's colours of R rays against the true ones (R, 3), float64."""
    pictures = [render(part) for part in _parts(rays, RAYS_AT_ONCE)]
    errors = (torch.cat([picture.color for picture in pictures]).double() - truth).abs()
    of_rays = errors.mean(-1)
    return Row(
        scene,
        sampler,
        count,
        evaluations=sum(picture.evaluations for picture in pictures) / len(rays),
        coarse_evaluations=sum(picture.coarse_evaluations for picture in pictures) / len(rays),
        mean_error=of_rays.mean().item(),
        half_width=1.96 * of_rays.std().item() / math.sqrt(len(rays)),
        max_error=errors.max().item(),
    )


def _parts(rays: Rays, size: int) -> list[Rays]:
    return [rays[start : start + size] for start in range(0, len(rays), size)]


def curves(rows: Iterable[Row]) -> dict[str, dict[str, Curve]]:
    """Rows by scene and sampler."""
    found: dict[str, dict[str, Curve]] = {}
    for row in rows:
        curve = found.setdefault(row.scene, {}).setdefault(row.sampler, Curve([], [], [], []))
        curve.evaluations.append(row.evaluations)
        curve.in_all.append(row.evaluations + row.coarse_evaluations)
        curve.errors.append(row.mean_error)
        curve.half_widths.append(row.half_width)
    return found


def costs(rows: Iterable[Row]) -> list[dict[str, Any]]:
    """Evaluations a ray that each of `TARGETS` takes, by scene and sampler; None where it is not met."""
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
    """What a filled grid of `STEPS` steps changes against a full one, and what each of `THRESHOLDS` does beyond."""
    everything, cells = partial(marched, scene, full_grid(STEPS), 0.0), partial(marched, scene, grid, 0.0)
    found = [changed(name, "empty cells", None, cells, everything, num_rays, seed)]
    for threshold in THRESHOLDS:
        stopped = partial(marched, scene, grid, threshold)
        found.append(changed(name, "hidden", threshold, stopped, cells, num_rays, seed))
    return found


def changed(
    scene: str, skipped: str, bound: float | None, render: Renderer, without: Renderer, num_rays: int, seed: int
) -> Skip:
    """How two renderers differ in the colours of random rays, and in evaluations.

    A NaN among the differences stays one, and keeps no bound.
    """
    differences, asked, asked_without = [], 0, 0
    for start in range(0, num_rays, SKIPPING_RAYS_AT_ONCE):
        rays = random_rays(min(SKIPPING_RAYS_AT_ONCE, num_rays - start), stream_seed(seed, start))
        picture, full = render(rays), without(rays)
        differences.append((picture.color - full.color).abs())
        asked, asked_without = asked + picture.evaluations, asked_without + full.evaluations
    difference = torch.cat(differences)
    largest = difference.max().item()
    kept = None if bound is None else largest <= bound
    mean = difference.double().mean().item()
    return Skip(scene, skipped, bound, mean, largest, kept, asked / num_rays, asked_without / num_rays)


# -- for people ---------------------------------------------------------------------------------------------------


def cost_table(needed: list[dict[str, Any]]) -> Table:
    """Evaluations of the field a ray by scene, sampler and mean error; with the coarse ones, in brackets."""
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
    """What skipping changes, and saves."""
    table = Table(title="what skipping changes of a colour, and the evaluations it saves", title_justify="left")
    for heading in ("scene", "skipped", "bound", "largest", "mean", "kept", "saved"):
        table.add_column(heading, justify="left" if heading in ("scene", "skipped") else "right")
    for skip in skips:
        saved = 1 - skip.evaluations / max(skip.evaluations_without, 1e-9)
        bound, kept = ("none", "") if skip.bound is None else (f"{skip.bound:.0e}", "yes" if skip.kept else "NO")
        figures = bound, f"{skip.max_error:.1e}", f"{skip.mean_error:.1e}", kept, f"{saved:.1%}"
        table.add_row(skip.scene, skip.skipped, *figures)
    return table
