"""Floaters: matter in front of surfaces, found from the photographs, and where it is."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.base.evenly_spaced import strided
from nerfloom.data.sparse_depth import sparse_depth
from nerfloom.edit.drop import floating
from nerfloom.edit.edited import Edited
from nerfloom.evaluation.evaluator import CLEAR_SHARE
from nerfloom.renderable import RendersRays
from nerfloom.splats.gaussians import HasGaussians
from nerfloom.training.loaded import Loaded

MAX_POINTS = 20_000
"""Maximum number of sightings of known points that are looked at, evenly spaced."""


class Floaters(NamedTuple):
    """The matter that floats in a scene."""

    positions: Tensor
    """(K, 3) float32 on the CPU, scene coordinates."""
    words: str
    """How many there are of how many, in words."""


def can_find(loaded: Loaded) -> bool:
    """Return whether `find_floaters` suits a run: Gaussians, or a method that casts rays, with photographs."""
    model = loaded.model
    return loaded.source is not None and not model.scene.warped and isinstance(model, (HasGaussians, RendersRays))


def find_floaters(loaded: Loaded, time: float | None) -> Floaters:
    """Return the matter that floats in front of surfaces that photographs see. Photographs are not decoded.

    These are the Gaussians that the step `drop_floaters` of ns-edit removes. For a method without Gaussians it is the
    matter in front of points of the reconstruction, in training images that see them: where ns-eval counts floaters,
    but in held-out images.

    Args:
        loaded: a run that `can_find` accepts.
        time: time in [0, 1] of a scene that moves; None for 0.

    Raises:
        ConfigError: if Gaussians cannot be drawn for the cameras, or no points are known.
        DataError: if the data cannot be read.
    """
    if isinstance(loaded.model, HasGaussians):
        edited = Edited.of(loaded, time)
        floats = floating(edited)
        words = f"{int(floats.sum()):,} of {len(floats):,} Gaussians float; ns-edit --drop-floaters True removes them"
        return Floaters(edited.in_scene().means.cpu()[floats], words)
    return _in_front_of_points(loaded)


@torch.no_grad()
def _in_front_of_points(loaded: Loaded) -> Floaters:
    """Return the positions of matter in front of points of the reconstruction."""
    model, parsed = loaded.model, loaded.parsed("train")
    assert isinstance(model, RendersRays)
    if parsed.sightings is None:
        raise ConfigError(f"{loaded.origin}: its data have no points with known distances that floaters could hide")
    cameras = parsed.cameras.scaled(1 / parsed.downscale_factor)
    known = sparse_depth(parsed.sightings, cameras)
    known = known[known.deviations < (1 - CLEAR_SHARE) / 3 * known.distances]
    known = known[torch.tensor(strided(len(known), MAX_POINTS), dtype=torch.int64)].to(model.device)
    times = None if parsed.times is None else parsed.times.to(model.device)
    seen, places = cameras.to(model.device), [torch.zeros(0, 3)]
    for start in range(0, len(known), model.rays_at_once):
        some = known[torch.arange(start, min(start + model.rays_at_once, len(known)), device=model.device)]
        rays = seen.pixel_rays(some.pixels, model.scene.near, model.scene.far, times)
        with model.rendering():
            depth = model.render(rays, model.background).median_depth.float()
        before = depth < CLEAR_SHARE * some.distances
        places.append((rays.origins + depth[:, None] * rays.directions)[before].float().cpu())
    found = torch.cat(places)
    return Floaters(found, f"{len(found):,} of {len(known):,} sightings of known points have something before them")
