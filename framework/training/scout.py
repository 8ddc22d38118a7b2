"""A scout: a field that is trained for a short time, only to find what other images contradict.

A rule that judges errors during training comes late. At first every error is large, so all pixels have to count. In
that time people become fog in front of their cameras, which explains them, and which nothing removes later. A scout is
thrown away, so its pictures may be worse if they show contradictions: its colours do not depend on the direction, and
gradients are scaled down near cameras, where fog forms. Afterwards every image is compared with it,
in full and at the same time, and the training begins afresh without the contradicted tiles.

An error contradicts an image only if other images agree about the same place. Detail that the scout has not learnt yet,
such as fine texture, is wrong in most images that see it. So the error of a tile is compared with the errors at the
places that it shows, over all images. RobustNeRF (Sabour et al. 2023) compares it with the errors of all pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from nerfloom.base.config import TrainConfig
from nerfloom.base.console import say, track
from nerfloom.base.plain import from_plain
from nerfloom.cameras.view import every
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.batch import gather_batch
from nerfloom.data.pixels.contradicted import LEAST
from nerfloom.data.pixels.left_out import LeftOutTiles
from nerfloom.data.pixels.tiles import Tiles
from nerfloom.data.scene import Scene
from nerfloom.geometry.bounds import to_unit_box
from nerfloom.geometry.rays import Rays
from nerfloom.kernels.encodings.contraction import contract_to_unit
from nerfloom.method import Method
from nerfloom.registry import load_method
from nerfloom.renderable import RendersRays, with_refined_poses
from nerfloom.training.progress import ProgressBar, StepReport

SHARE, MAX_STEPS = 0.15, 2_000
"""Share of the budget for the scout, and its maximum number of steps."""
SETTINGS: dict[str, Any] = {"robust": "errors", "gradient_scaling": True, "vis": "none"}
"""Settings of every scout."""
SCOUTS: dict[bool, tuple[str, dict[str, Any]]] = {
    False: (
        "instant-ngp",
        {"view_dependence": False, "rays_per_pixel": 1, "log2_table_size": 16, "samples_per_batch": 2**14, "detail": 1},
    ),
    # With the mean appearance, all of an image in other light would be wrong in one direction.
    True: ("nerfacto", {"mean_appearance_share": 0.0}),
}
"""Method and settings of a scout, by whether there may be something outside the box or light differs."""
MAX_PROBES = 2**19
"""Approximate number of pixels of all images that are compared with the scout."""
PROBES_ALONG = 2
"""Minimum number of compared pixels along a side of a tile."""
NEAR = 1 / 16, 2 / 16, 1 / 16, 2 / 16, 4 / 16, 2 / 16, 1 / 16, 2 / 16, 1 / 16
"""Weights of 3 x 3 tiles in the mean error around a tile."""
CELLS = 32
"""Cells along an axis of the grid that tells places apart, which covers the box, or all of contracted space."""
TYPICAL = 0.25
"""The typical error of a place is this quantile of the errors of the tiles that show it: up to 75 % of the images may
show something else there."""
MIN_IMAGES = 3
"""Minimum number of images that show a place with an error of its own; elsewhere the error of all places is typical."""
CLEARLY = 6.0
"""A tile is contradicted if the square of its mean error is this many times the typical one, and exceeds `LEAST`^2."""
MOST = 0.8
"""Maximum share of the tiles without a warning."""


class Training(Protocol):
    """A training that can be taken step by step, such as `nerfloom.training.trainer.Trainer`."""

    model: Any
    """The model."""

    def steps(self) -> Iterator[StepReport]:
        """Take steps until the budget is spent, and yield their reports."""


def scout(
    train: Callable[[Method, TrainConfig, Dataset], Training],
    dataset: Dataset,
    tiles: LeftOutTiles,
    config: TrainConfig,
    **settings: Any,
) -> None:
    """Find the tiles of images that the other images contradict.

    Args:
        train: returns a training of a method with given settings on a data set. It is an argument because the caller
            may be a training itself.
        dataset: the images, on the device.
        tiles: their tiles; whether each is left out is written to them.
        config: settings; the scout shares their machine, background and precision.
        settings: further settings of the scout, with its budget.
    """
    scene = dataset.scene
    name, own = SCOUTS[scene.unbounded or scene.appearance_varies]
    method = load_method(name)
    shared = {"machine": config.machine, "background": config.background, "mixed_precision": config.mixed_precision}
    training = train(method, from_plain(method.config, {**SETTINGS, **own, **shared, **settings}, "scout"), dataset)
    with ProgressBar(f"{name}, to find what moves") as bar:
        for report in training.steps():
            bar.show(report)
    found = compare(training.model, dataset, tiles.tiles)
    out = contradicted(found, tiles.tiles.neighbours())
    tiles.state.copy_(out)
    say(f"{float(out.float().mean()):.1%} of the images' tiles are contradicted by other images, and left out")
    if out.float().mean() > MOST:
        say("warning: that is nearly everything. Are poses wrong, or does light differ? Try --robust off")


def budget(config: TrainConfig) -> dict[str, Any]:
    """Return the budget of a scout, as settings.

    Args:
        config: settings of the training, with its budget.
    """
    steps, seconds = config.max_num_iterations, config.max_seconds
    most = MAX_STEPS if steps is None else min(max(round(SHARE * steps), 1), MAX_STEPS)
    return {
        "max_num_iterations": None if steps is None and seconds is not None else most,
        "max_seconds": None if seconds is None else SHARE * seconds,
    }


@dataclass(frozen=True)
class Comparison:
    """Comparison of images with a field: N probed pixels, in T tiles."""

    sums: Tensor
    """(T, 4) sums of the signed errors of the three channels over the probes of each tile, and their number."""
    owners: Tensor
    """(N,) int64 tile of each probe."""
    cells: Tensor
    """(N,) int64 cell of the place that the field shows in it."""
    seen_by: Tensor
    """(CELLS^3 + 1,) int64 number of images with probes in each cell."""


@torch.no_grad()
def compare(model: RendersRays, dataset: Dataset, tiles: Tiles) -> Comparison:
    """Compare training images with a field, at evenly spaced pixels. Each is rendered in the light of its image.

    Args:
        model: the field's model.
        dataset: the images, on the model's device.
        tiles: their tiles.
    """
    seen, behind = with_refined_poses(model, dataset), model.background
    cameras, total = seen.cameras, seen.cameras.ends[-1]
    stride = max(min(round(math.sqrt(total / MAX_PROBES)), tiles.side // PROBES_ALONG), 1)
    sums, owners, cells = behind.new_zeros(tiles.total, 4), list[Tensor](), list[Tensor]()
    seen_by = torch.zeros(CELLS**3 + 1, dtype=torch.int64, device=behind.device)
    for index in track(range(len(seen)), "Comparing images with it", total=len(seen)):
        pixels = every(cameras.image_pixels(index).view(cameras.sizes[index]), stride).reshape(-1)
        if seen.kept is not None:
            pixels = pixels[seen.kept.contains(pixels)]
        first = len(cells)
        for part in pixels.split(model.rays_at_once):
            batch = gather_batch(seen, part, behind.repeat(len(part), 1))
            with model.rendering():
                shown = model.render(batch.rays, behind)
            errors = torch.nan_to_num(shown.rgb.float() - batch.rgb, 0.0, 0.0, 0.0)
            owners.append(tiles.of(part))
            sums.index_add_(0, owners[-1], torch.cat([errors, torch.ones_like(errors[:, :1])], -1))
            cells.append(places(batch.rays, shown.median_depth.float(), shown.accumulation > 0.5, model.scene))
        seen_by[torch.cat([*cells[first:], seen_by[:0]]).unique()] += 1
    return Comparison(sums, torch.cat(owners), torch.cat(cells), seen_by)


def places(rays: Rays, depths: Tensor, solid: Tensor, scene: Scene) -> Tensor:
    """Return the cell (R,) int64 of the place where each ray ends; one more cell is for rays that end nowhere.

    Args:
        rays: R rays.
        depths: (R,) distances where they end, scene units.
        solid: (R,) bool, whether they end on something.
        scene: the scene, with its box.
    """
    positions, box = rays.origins + depths[:, None] * rays.directions, scene.box.to(depths)
    unit = contract_to_unit(positions, box) if scene.unbounded else to_unit_box(positions, box)
    x, y, z = (CELLS * torch.nan_to_num(unit)).clamp(0, CELLS - 1).long().unbind(-1)
    return torch.where(solid, (x * CELLS + y) * CELLS + z, CELLS**3)


def contradicted(found: Comparison, around: Tensor) -> Tensor:
    """Return which tiles (T,) bool the other images contradict.

    The error of a tile is the mean signed error around it. Its square is averaged over 3 x 3 tiles and compared with
    the typical error of the places that its probes show.

    Args:
        found: the comparison of images with a field.
        around: (T, 9) the 3 x 3 tiles around each (`Tiles.neighbours`).
    """
    scores, counts = scores_of(found.sums, around), found.sums[:, 3]
    values, known = scores[found.owners], found.seen_by[found.cells] >= MIN_IMAGES
    there, anywhere = (quantiles(values, groups, TYPICAL) for groups in (found.cells, torch.zeros_like(found.cells)))
    typical = torch.zeros_like(scores).index_add_(0, found.owners, torch.where(known, there, anywhere))
    return (counts > 0) & (scores > (CLEARLY * typical / counts.clamp(min=1)).clamp(min=LEAST**2))


def scores_of(sums: Tensor, around: Tensor) -> Tensor:
    """Return the squared mean signed error (T,) around each tile, a mean over 3 x 3 tiles.

    `sums` and `around` are as in `Comparison` and `contradicted`.
    """
    blurred = (sums[around] * sums.new_tensor(NEAR)[:, None]).sum(1)
    squares, counts = (blurred[:, :3] / blurred[:, 3:].clamp(min=1e-6)).square().mean(-1), blurred[:, 3]
    return (squares[around] * counts[around]).sum(-1) / counts[around].sum(-1).clamp(min=1e-6)


def quantiles(values: Tensor, groups: Tensor, share: float) -> Tensor:
    """Return the quantile of each value's group, (N,).

    Args:
        values: (N,).
        groups: (N,) int64 number of each value's group, from 0.
        share: share of a group's values that are at most its quantile, rounded down to one of the values.
    """
    order = values.argsort()
    order = order[groups[order].argsort(stable=True)]
    sizes = torch.bincount(groups)
    ranks = sizes.cumsum(0) - sizes + (share * (sizes - 1)).long().clamp(min=0)
    return values[order[ranks[groups]]]
