"""What a run skipped, and what that saved: printed at its end and written to skip_report.json."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import torch

from framework.base.device import wait_for
from framework.data.pixels import draw_batch
from framework.geometry.rays import Rays
from framework.model import parts
from framework.ray_model import RayModel
from framework.samplers.base import SkipsCells

if TYPE_CHECKING:
    from framework.training.trainer import Trainer

PROBE_RAYS = 1024
LEAST_TOLD = 0.005
"""Share from which on what is skipped is told to people."""


@dataclass(frozen=True)
class Rung:
    """One thing that is skipped."""

    name: str
    """What."""
    skipped: float
    """Share of all that there is, 0 to 1."""
    rendering_saved: float | None
    """How many times longer the probe's rays take to render without it; None where it saves nothing in rendering."""
    switch: str
    """How to turn it off."""
    says: str
    """What was skipped and what that saved, for people."""


def lines(rungs: list[Rung]) -> list[str]:
    """For people; without what saved nothing."""
    told = [f"  {rung.says}" for rung in rungs if rung.skipped >= LEAST_TOLD]
    return ["left out:", *told] if told else []


@torch.no_grad()
def skip_report(trainer: Trainer) -> list[Rung]:
    """Measure a trained run's rungs on a probe of random training rays. Empty where a method skips nothing."""
    model, rungs = trainer.model, []
    samplers = parts(model, SkipsCells)
    if samplers and isinstance(model, RayModel):
        rungs += _sampling_rungs(trainer, model, samplers)
    if trainer.optimizer.entries_there:
        share = trainer.optimizer.entries_updated / trainer.optimizer.entries_there
        says = f"parameters that a step does not use: {1 - share:.0%} of each update of the feature tables"
        rungs.append(Rung("table entries in a step's update", 1 - share, None, "--sparse-updates False", says))
    return rungs


def _sampling_rungs(trainer: Trainer, model: RayModel[Any], samplers: list[SkipsCells]) -> list[Rung]:
    cells = sum(s.occupied.numel() for s in samplers)
    kept, drawn = trainer.train_set.kept, trainer.train_set.drawn
    carved = sum(int(s.carved.sum()) for s in samplers) / cells
    empty = 1 - sum(int(s.occupied.sum()) for s in samplers) / cells
    rays = draw_batch(trainer.train_set, PROBE_RAYS, "black").rays
    usual, count = _probe(model, rays)
    with _changed(samplers, early_stop=0.0):
        unhidden, visible_count = _probe(model, rays)
        with _changed(samplers, occupied=True):
            everywhere, all_count = _probe(model, rays)
    rungs = [Rung("cells, empty", empty, None, "no switch", f"empty space: {empty:.0%} of the box is never sampled")]
    if carved:
        says = f"{carved:.0%} of the box from the first step on, for the photographs show nothing there"
        rungs.append(Rung("cells, outside the visual hull", carved, None, "--silhouette-cells False", says))
    rungs += [
        Rung(
            "steps along a ray, in empty cells",
            1 - visible_count / max(all_count, 1),
            everywhere / unhidden,
            "no switch",
            _along_rays("empty space along rays", all_count, visible_count, everywhere / unhidden),
        ),
        Rung(
            "the samples left, hidden",
            1 - count / max(visible_count, 1),
            unhidden / usual,
            "--early-stop 0",
            _along_rays("behind opaque surfaces", visible_count, count, unhidden / usual),
        ),
    ]
    if drawn is not None and (kept is None or len(drawn) < len(kept)):  # else masks alone say what is drawn
        share = 1 - len(drawn) / len(trainer.train_set.pixels if kept is None else kept)
        says = f"pixels that show only background: {share:.0%} of all are never drawn"
        if share < 1:
            says += f", and the others {1 / (1 - share):.1f} x as often"
        rungs.append(Rung("pixels, which see background alone", share, None, "--silhouette-pixels False", says))
    return rungs


def _along_rays(place: str, before: int, after: int, faster: float) -> str:
    """A line about samples of the probe's rays that are not taken."""
    left_out = 1 - after / max(before, 1)
    a_ray = f"{after / PROBE_RAYS:.1f} a ray instead of {before / PROBE_RAYS:.1f}"
    return f"{place}: {left_out:.0%} of samples, {a_ray}; renders {faster:.1f} x as fast"


def _probe(model: RayModel[Any], rays: Rays) -> tuple[float, int]:
    """Seconds to render the rays, and samples evaluated for them."""
    was_training = model.training
    model.eval()
    background = torch.zeros(3, device=model.device)
    model.render(rays, background)  # once to warm up
    wait_for(model.device)
    start = time.perf_counter()
    rendered = model.render(rays, background)
    wait_for(model.device)
    seconds = time.perf_counter() - start
    model.train(was_training)
    return seconds, rendered.num_samples


@contextmanager
def _changed(samplers: list[SkipsCells], early_stop: float | None = None, occupied: bool = False) -> Iterator[None]:
    """Samplers without early stop, or with a full grid, for a while."""
    before = [(s.early_stop, s.occupied.clone()) for s in samplers]
    try:
        for sampler in samplers:
            if early_stop is not None:
                sampler.early_stop = early_stop
            if occupied:
                sampler.occupied.fill_(True)
            sampler.forget()
        yield
    finally:
        for sampler, (stop, cells) in zip(samplers, before, strict=True):
            sampler.early_stop = stop
            sampler.occupied.copy_(cells)
            sampler.forget()


def as_plain(rungs: list[Rung]) -> list[dict[str, Any]]:
    """For JSON."""
    return [asdict(rung) for rung in rungs]
