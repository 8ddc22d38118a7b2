"""Baking: turn a trained field into an octree, which a CPU draws in real time.

The steps follow PlenOctrees (Yu et al. 2021): find the cells with matter that training images see, fit harmonics
to the field's colours, then learn all leaves from the photographs. A model that is an octree already keeps its leaves.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.config import TrainConfig
from nerfloom.base.console import say
from nerfloom.base.device import seed_step
from nerfloom.base.errors import ConfigError
from nerfloom.data.dataset import Dataset
from nerfloom.export.octree_cells import MatterSearch
from nerfloom.export.octree_colors import Seen, field_colors, fitted_colors, seen_leaves
from nerfloom.export.octree_size import BITS, DEGREES, chosen, is_too_fine, room_for, visible_leaves
from nerfloom.kernels.octree.layout import OctreeLayout
from nerfloom.kernels.octree.light import depths_of, raw_of
from nerfloom.method import Method
from nerfloom.octree_model import OctreeConfig, OctreeModel
from nerfloom.octrees.drawn import DrawsOctree
from nerfloom.octrees.octree import Octree
from nerfloom.octrees.packing import packed
from nerfloom.ray_model import RayModel
from nerfloom.renderable import RendersFromImages
from nerfloom.training.loaded import Loaded
from nerfloom.training.progress import take_all
from nerfloom.training.trainer import Trainer

METHOD = Method(OctreeConfig(), paper="arXiv:2103.14024", model=OctreeModel, name="octree")
"""Learning of an octree from photographs."""
MAX_BYTES = 30e6
"""Default of the maximum size of a file, bytes."""
MIN_RESOLUTION, MAX_RESOLUTION = 32, 512
"""Range of the cells along the longest edge, if no number is given."""
MAX_UNBOUNDED_RESOLUTION = 256
"""Maximum of this number in an unbounded scene, where each of several boxes has as many cells."""
CELLS_PER_PIXEL = 1.28
"""Cells along the longest edge, if no number is given, relative to the pixels along the images' longer side. Images do
not see each of much smaller cells, and pictures from elsewhere have holes."""


@dataclass(frozen=True)
class Baking:
    """Settings of baking."""

    resolution: int | None = None
    """Cells along the longest edge of the matter's box; None to choose them by the images' size and `max_bytes`."""
    max_bytes: float = MAX_BYTES
    """Maximum size of the file, bytes."""
    degree: int | None = None
    """Degree of the harmonics, 0 to 3; None to choose it by `max_bytes`."""
    seconds: float = 30.0
    """Time to learn from the photographs; 0 for none."""


def bake(loaded: Loaded, settings: Baking) -> Octree:
    """Return the octree of a trained run, on the CPU, and report the kept leaves.

    Args:
        loaded: the run.
        settings: size, resolution and time.

    Raises:
        ConfigError: if an octree cannot represent the run.
    """
    model = loaded.model
    layout, depths, coefficients = (
        _as_learnt(model, loaded, settings) if isinstance(model, DrawsOctree) else _baked(loaded, settings)
    )
    leaves, lost = packed(depths, coefficients, BITS)
    leaves = replace(leaves, table=leaves.table.repeat(len(layout.levels)))
    say(f"rounded to bytes: opacities of cells by {lost.opacity:.2g}, colours by {lost.color:.2g} (root mean square)")
    scene = model.scene
    return Octree(layout, leaves, loaded.input_placement, scene.near, scene.far, scene.has_alpha, scene.image_size)


def _as_learnt(model: DrawsOctree, loaded: Loaded, settings: Baking) -> tuple[OctreeLayout, Tensor, Tensor]:
    """Return the leaves of a model that is an octree, on the CPU, as far as they fit into the file.

    They are the layout, the optical depths (L,) and the coefficients (L, 3 K).
    """
    layout, depths, coefficients = model.layout.to("cpu"), model.depths().cpu(), model.coefficients().cpu()
    degree = math.isqrt(coefficients.shape[1] // 3) - 1
    if settings.degree not in (None, degree):
        raise ConfigError(f"--degree is {settings.degree}, and the run's leaves have {degree}: leave it out")
    if layout.num_leaves > room_for(settings.max_bytes, degree):
        cameras, scene = loaded.dataset("train").to("cpu").cameras, model.scene
        seen = seen_leaves(layout, raw_of(depths)[:, None], cameras, scene.near, scene.far)
        kept, count = chosen(seen.largest, settings.max_bytes, (degree,))[1], layout.num_leaves
        say(f"{settings.max_bytes / 1e6:g} MB hold {len(kept):,} of {count:,} leaves: those with the largest weights")
        layout, rows = layout.part(kept)
        depths, coefficients = depths[rows], coefficients[rows]
    say(f"{layout.num_leaves:,} leaves with harmonics of degree {degree}, as they were learnt")
    return layout, depths, coefficients


def _baked(loaded: Loaded, settings: Baking) -> tuple[OctreeLayout, Tensor, Tensor]:
    """Return leaves with the density and the colours of a field: layout, depths (L,) and coefficients (L, 3 K)."""
    model, dataset = _bakeable(loaded), loaded.dataset("train").to("cpu")
    seed_step(loaded.run.config.machine.seed, 0)
    degrees = DEGREES if settings.degree is None else (settings.degree,)
    pixels = int(CELLS_PER_PIXEL * model.scene.image_size)
    most = MAX_UNBOUNDED_RESOLUTION if model.scene.unbounded else MAX_RESOLUTION
    resolution = settings.resolution or min(max(pixels, MIN_RESOLUTION), most)
    search = MatterSearch(model)
    layout, raw, seen = _visible(model, search, dataset, resolution)
    while settings.resolution is None and resolution > MIN_RESOLUTION:
        if not is_too_fine(seen.largest, settings.max_bytes, degrees):
            break
        resolution //= 2
        say(f"half of these would not fit; {resolution} cells along the longest edge instead")
        layout, raw, seen = _visible(model, search, dataset, resolution)
    depths, places = depths_of(raw[:, 0]), layout.centers()
    shown, rows = layout.part(seen.largest.nonzero()[:, 0])
    del seen  # it takes as much memory as the new one
    depths[rows], places[rows] = search.averaged(shown, depths[rows])
    raw = raw_of(depths)[:, None]
    # The new depths are often smaller, so leaves behind a surface show that its centres hid.
    seen = seen_leaves(layout, raw, dataset.cameras, model.scene.near, model.scene.far)
    degree, kept = chosen(seen.largest, settings.max_bytes, degrees)
    visible = len(visible_leaves(seen.largest))
    if len(kept) < visible:
        say(f"the size leaves room for {len(kept):,} of {visible:,} leaves: those with the largest weights")
    layout, rows = layout.part(kept)
    raw, depths, places, seen = raw[rows], depths[rows], places[rows], seen.part(rows)
    say(f"{layout.num_leaves:,} leaves with harmonics of degree {degree}, cells of {layout.cell:.3g} scene units")
    firsts, fitted = layout.firsts_of_levels, list[Tensor]()
    for level, first, end in zip(layout.levels, firsts, firsts[1:], strict=False):
        if first < end:
            own, part = places[first:end], seen.part(torch.arange(first, end))
            fitted.append(fitted_colors(field_colors(model, own, level.cell), own, part, degree))
    coefficients = torch.cat(fitted)
    if settings.seconds > 0:
        drawn = dataset.drawing(seen.pixels)
        depths, coefficients = learnt(layout, raw, coefficients, drawn, settings.seconds, loaded.run.config)
    return layout, depths, coefficients


def _bakeable(loaded: Loaded) -> RayModel[Any]:
    """Return the run's model; refuse a model that an octree cannot represent."""
    model, name = loaded.model, loaded.method
    if not isinstance(model, RayModel):
        raise ConfigError(f"{name} has no field to bake; take a run of a method that casts rays")
    reason = None
    if isinstance(model, RendersFromImages):
        reason = "it renders from images, and has no field without them"
    elif model.scene.moving:
        reason = "its scene moves, and an octree does not"
    elif model.scene.warped:
        reason = "its rays are in normalised device coordinates; train without --ndc"
    elif model.scene.unbounded and not model.field.unbounded:
        reason = "its scene extends beyond its box, where its field ends"
    if reason is not None:
        raise ConfigError(f"this run of {name} cannot be baked: {reason}; 'ns-export web' shows it as Gaussians")
    return model


def _visible(
    model: RayModel[Any], search: MatterSearch, dataset: Dataset, resolution: int
) -> tuple[OctreeLayout, Tensor, Seen]:
    """Return cells with matter, their raw densities (L, 1), and how training images see them."""
    grids = search.grids(resolution)
    layout, depths = search.layout(grids)
    if not layout.num_leaves:
        raise ConfigError("the run has no matter in its box; is it trained?")
    raw = raw_of(depths)[:, None]
    seen = seen_leaves(layout, raw, dataset.cameras, model.scene.near, model.scene.far)
    visible = len(visible_leaves(seen.largest))
    edges = " x ".join(str(8 * count) for count in grids[0].size)
    edges += f" x {len(grids)}" if len(grids) > 1 else ""
    say(f"{layout.num_leaves:,} of {edges} cells have matter, and training images see {visible:,} of these")
    return layout, raw, seen


def learnt(
    layout: OctreeLayout, raw: Tensor, coefficients: Tensor, dataset: Dataset, seconds: float, run: TrainConfig
) -> tuple[Tensor, Tensor]:
    """Return optical depths (L,) and coefficients (L, 3 K) after learning from photographs.

    Args:
        layout: where the L leaves are.
        raw: (L, 1) raw densities at the start.
        coefficients: (L, 3 K) coefficients at the start.
        dataset: the training images.
        seconds: time to learn.
        run: settings of the baked run. Its machine is used, and what it leaves out of photographs (`robust`).
    """
    config: Any = METHOD.config
    own = {"max_seconds": seconds, "max_num_iterations": None, "vis": "none"}
    config = replace(config, **own, robust=run.robust, machine=run.machine)
    trainer = Trainer(METHOD, config, dataset)
    trainer.prepare(start=False)
    model = trainer.model
    assert isinstance(model, OctreeModel)
    model.set_octree(layout, raw, coefficients)
    start, state = time.perf_counter(), trainer.state
    take_all(trainer.steps(), "Learning from photographs")
    say(
        f"{state.step:,} steps on photographs in {time.perf_counter() - start:.0f} s: {state.train_psnr:.2f} dB on them"
    )
    return model.depths(), model.colors.table.detach()
