"""Report of the work that a run skipped and the time that it saved, printed and written to skip_report.json."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import torch

from nerfloom.base.device import wait_for
from nerfloom.base.evenly_spaced import evenly_spaced
from nerfloom.cameras.view import View
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.batch import draw_batch
from nerfloom.evaluation.error_bound import limited_error
from nerfloom.gaussian_model import GaussianModel
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.march.occupancy import own_cells
from nerfloom.model import evaluating
from nerfloom.ray_model import RayModel
from nerfloom.renderable import parts
from nerfloom.samplers.base import SkipsCells
from nerfloom.samplers.first_crossing import FirstCrossing
from nerfloom.samplers.occupancy import OccupancySampler
from nerfloom.splats.drawing import splat_camera

if TYPE_CHECKING:
    from nerfloom.training.trainer import Trainer

PROBE_RAYS, WARM_UP_RAYS = 1024, 64
"""Numbers of random training rays for measuring the savings, and for the warm-up before."""
PROBE_VIEWS = 4
"""Maximum number of training images for counting the Gaussians that they show."""
MIN_REPORTED = 0.005
"""Minimum skipped fraction to print."""
MIN_SPEEDUP = 1.1
"""Minimum speed-up of rendering to print."""


@dataclass(frozen=True)
class Rung:
    """One kind of skipped work."""

    name: str
    """Name of the skipped work."""
    skipped: float
    """Skipped fraction of all such work, 0 to 1."""
    rendering_saved: float | None
    """Speed-up of rendering the probe's rays; None if skipping does not affect rendering."""
    switch: str
    """Flag that turns it off."""
    says: str
    """Description as text."""


def lines(rungs: list[Rung]) -> list[str]:
    """Return the descriptions as lines of text, without `rungs` that skipped less than MIN_REPORTED."""
    descriptions = [f"  {rung.says}" for rung in rungs if rung.skipped >= MIN_REPORTED]
    return ["left out:", *descriptions] if descriptions else []


@torch.no_grad()
def skip_report(trainer: Trainer) -> list[Rung]:
    """Measure the work that the model of `trainer` skips, on training rays or images; empty if it skips nothing."""
    model, rungs = trainer.model, []
    samplers = parts(model, SkipsCells)
    if samplers and isinstance(model, RayModel):
        rungs += _sampling_rungs(trainer, model, samplers)
    capacities = [sampler.capacity for sampler in parts(model, OccupancySampler)]
    if (rays := sum(capacity.rays for capacity in capacities)) > 0:
        share = sum(capacity.left_out for capacity in capacities) / rays
        says = f"rays of batches, dropped because the sample buffer was full: {share:.1%}"
        rungs.append(Rung("rays of batches, buffer full", share, None, "no switch", says))
    if isinstance(model, GaussianModel):
        rungs += _drawing_rungs(trainer.train_set, model)
    updated, there = trainer.optimizer.entries
    if there:
        share = updated / there
        says = f"parameters that a step does not use: {1 - share:.0%} of each update"
        rungs.append(Rung("table entries in a step's update", 1 - share, None, "--sparse-updates False", says))
    return rungs


def _sampling_rungs(trainer: Trainer, model: RayModel[Any], samplers: list[SkipsCells]) -> list[Rung]:
    own = [own_cells(s.levels, s.resolution).repeat(s.slices).to(s.carved.device) for s in samplers]
    cells = sum(int(mask.sum()) for mask in own)
    kept, drawn = trainer.train_set.kept, trainer.train_set.drawn
    carved = sum(int((s.carved & mask).sum()) for s, mask in zip(samplers, own, strict=True)) / cells
    empty = 1 - sum(int(s.occupied.sum()) for s in samplers) / cells
    rays = draw_batch(trainer.train_set, PROBE_RAYS, "black").rays
    tracers = parts(model, FirstCrossing)
    with _tracing(tracers, False):
        usual, count = _probe(model, rays)
        with limited_error(model, 0.0):
            unhidden, visible_count = _probe(model, rays)
            with _all_occupied(samplers):
                everywhere, all_count = _probe(model, rays)
    nested = any(s.levels > 1 for s in samplers)
    where = "all cells" if nested else "the box"
    no_cells = "no switch" if nested else "--grid-resolution 1"
    rungs = [Rung("cells, empty", empty, None, no_cells, f"empty space: {empty:.0%} of {where} is never sampled")]
    if carved:
        says = f"{carved:.0%} of {where} from the first step, since the photographs show nothing there"
        switch = "--seen-cells False" if nested else "--silhouette-cells False"
        rungs.append(Rung("cells, outside the visual hull", carved, None, switch, says))
    rungs += [
        Rung(
            "steps along a ray, in empty cells",
            1 - visible_count / max(all_count, 1),
            everywhere / unhidden,
            no_cells,
            _along_rays("empty space along rays", all_count, visible_count, everywhere / unhidden),
        ),
        Rung(
            "the samples left, hidden",
            1 - count / max(visible_count, 1),
            unhidden / usual,
            "--early-stop 0 --train-early-stop 0",
            _along_rays("behind opaque surfaces", visible_count, count, unhidden / usual),
        ),
    ]
    if tracers:
        with _tracing(tracers, True):
            seconds, evaluated = _probe(model, rays)[0], sum(tracer.evaluations for tracer in tracers)
        says = _along_rays("if pictures are traced (--eval-rendering surface)", count, evaluated, usual / seconds)
        share = max(1 - evaluated / max(count, 1), 0.0)
        rungs.append(Rung("samples, traced", share, usual / seconds, "--eval-rendering volume", says))
    if drawn is not None and (kept is None or len(drawn) < len(kept)):  # otherwise masks alone choose the drawn pixels
        share = 1 - len(drawn) / len(trainer.train_set.pixels if kept is None else kept)
        says = f"pixels that show only background: {share:.0%} of all are never drawn"
        if share < 1:
            says += f", and the others {1 / (1 - share):.1f} x as often"
        rungs.append(Rung("pixels, which see background alone", share, None, "--silhouette-cells False", says))
    return rungs


def _drawing_rungs(dataset: Dataset, model: GaussianModel[Any]) -> list[Rung]:
    rungs, total, sizes = [], len(model.columns["means"].values), model.sizes
    indices = evenly_spaced(len(dataset), PROBE_VIEWS).tolist()
    if total:
        share = 1 - sum(_num_listed(model, dataset.view(index)) for index in indices) / (len(indices) * total)
        says = f"Gaussians that an image does not show: {share:.0%}, in the mean of {len(indices)} training images"
        rungs.append(Rung("Gaussians, not in an image", share, None, "no switch", says))
    if needed := model.capacity.entries:
        share = model.capacity.left_out / needed
        says = f"entries of tiles' lists of Gaussians, dropped because the buffer was full: {share:.1%}"
        rungs.append(Rung("entries of tiles' lists, buffer full", share, None, "no switch", says))
    if count := sizes.steps.total():
        share = 1 - sum(steps / 4**octaves for octaves, steps in sizes.steps.items()) / count
        widths = ", ".join(f"{sizes.steps[o] / count:.0%} of steps 1/{1 << o}" for o in sorted(sizes.steps) if o)
        says = f"pixels of training images: {share:.0%}, since steps use smaller images ({widths})"
        rungs.append(Rung("pixels of training images", share, None, "--reduced-until 0", says))
    return rungs


def _num_listed(model: GaussianModel[Any], view: View) -> int:
    """Return the number of Gaussians in the lists of a view's tiles: the others are neither sorted nor blended."""
    camera = splat_camera(view.camera, model.near, model.look())
    lists = model.rasteriser.tile(model.rasteriser.project(model.gaussians_in(view), camera), camera)
    return len(lists.ids[: int(lists.offsets[-1])].unique())


def _along_rays(place: str, before: int, after: int, faster: float) -> str:
    """Return a line about skipped samples of the probe's rays."""
    skipped = 1 - after / max(before, 1)
    a_ray = f"{after / PROBE_RAYS:.1f} a ray instead of {before / PROBE_RAYS:.1f}"
    speed = f"; renders {faster:.1f} x as fast" if faster >= MIN_SPEEDUP else ""
    return f"{place}: {skipped:.0%} of samples, {a_ray}{speed}"


def _probe(model: RayModel[Any], rays: Rays) -> tuple[float, int]:
    """Return the seconds to render the rays and the number of evaluated samples."""
    background = torch.zeros(3, device=model.device)
    with evaluating(model):
        model.shown(rays[:WARM_UP_RAYS], background)
        wait_for(model.device)
        start = time.perf_counter()
        rendered = model.shown(rays, background)
        wait_for(model.device)
        seconds = time.perf_counter() - start
    return seconds, int(rendered.num_samples)


@contextmanager
def _all_occupied(samplers: list[SkipsCells]) -> Iterator[None]:
    """Mark all cells occupied within a `with` block."""
    before = [sampler.occupied.clone() for sampler in samplers]
    try:
        for sampler in samplers:
            sampler.occupied.fill_(True)
            sampler.forget()
        yield
    finally:
        for sampler, cells in zip(samplers, before, strict=True):
            sampler.occupied.copy_(cells)
            sampler.forget()


@contextmanager
def _tracing(tracers: list[FirstCrossing], traces: bool) -> Iterator[None]:
    """Trace pictures, or do not, within a `with` block."""
    before = [tracer.traces for tracer in tracers]
    try:
        for tracer in tracers:
            tracer.traces = traces
        yield
    finally:
        for tracer, own in zip(tracers, before, strict=True):
            tracer.traces = own


def as_plain(rungs: list[Rung]) -> list[dict[str, Any]]:
    """Return `rungs` as plain data, for JSON."""
    return [asdict(rung) for rung in rungs]
