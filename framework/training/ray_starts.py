"""Decision whether rays start at their near ends, or only where several training images look."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from nerfloom.base.config import RayConfig, TrainConfig
from nerfloom.base.decisions import Decision, is_open
from nerfloom.base.evenly_spaced import evenly_spaced
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.poses import looked_at
from nerfloom.data.dataset import Dataset
from nerfloom.data.free_space import before_points
from nerfloom.method import SHARED_BY
from nerfloom.samplers.choice import SamplingConfig
from nerfloom.scene.shared_space import SharedSpace, share_cut_off

MOST_CUT_OFF = 0.002
"""Maximum share of a reconstruction's points that rays may miss where they start late."""
LATEST, MOST_LATE = 0.8, 0.02
"""Without points: what is seen is taken to be no nearer than this share of the distance to what all cameras look at,
and the maximum share of rays that may start behind that."""
TESTED_RAYS = 20_000
"""Number of rays that are tested."""
UNKNOWN = "no points say whether anything is cut off"
"""Reason to start at the near ends where nothing can be tested."""


def starts_checked(
    config: TrainConfig, settings: TrainConfig, made: list[Decision], dataset: Dataset
) -> tuple[TrainConfig, list[Decision]]:
    """Let rays start at their near ends where they would else start behind what they are likely to show.

    The cells that images show are coarse beside cameras that stand close together right before the scene: of LLFF's
    fern they cut off 9 % of what rays meet, and 2 dB. The points of a reconstruction say whether they do. Without
    points, the rays' starts are compared with the place that all cameras look at: at fern they are behind it, in
    captures that go around something they are well before it.

    Args:
        config: the run's settings.
        settings: the same, as far as the method has decided what they leave open.
        made: the decisions that were made.
        dataset: the training images.

    Returns:
        The settings and the decisions.
    """
    if not isinstance(config, RayConfig) or not is_open(config.rays_shared_by) or not isinstance(settings, RayConfig):
        return settings, made
    scene = dataset.scene
    in_boxes = isinstance(settings, SamplingConfig) and str(settings.sampler) == "occupancy"
    if not scene.unbounded or scene.warped or in_boxes or not settings.rays_shared_by:
        return settings, made
    reason = _why_not(dataset, settings.rays_shared_by)
    if reason is None:
        return settings, made
    started = Decision("rays start", "at their near ends", f"{reason} (else: --rays-shared-by {SHARED_BY})")
    return replace(settings, rays_shared_by=0), [*made, started]


def nearest_shown(dataset: Dataset) -> Tensor:
    """Return the distance (M,) from each camera before which its image shows nothing, as far as points tell.

    Args:
        dataset: M training images.
    """
    near = torch.full_like(dataset.cameras.fx, dataset.scene.near)
    return near if dataset.sparse_depth is None else near.maximum(before_points(dataset.cameras, dataset.sparse_depth))


@torch.no_grad()
def share_late(space: SharedSpace, cameras: Cameras, near: float, far: float) -> float | None:
    """Return the share of the pixels' rays that start hardly before what the cameras look at, or behind it.

    What is seen is taken to be no nearer to a camera than `LATEST` of the way to the point nearest to all optical axes.

    Args:
        space: cells where no ray starts.
        cameras: M cameras.
        near, far: distances at which rays start and end else, scene units.

    Returns:
        A share in [0, 1]; None if that point is behind most of the cameras, so that they look apart.
    """
    target = looked_at(cameras.camera_to_worlds)
    if target is None:
        return None
    pixels = evenly_spaced(int(cameras.offsets[-1]), TESTED_RAYS).to(cameras.fx.device)
    rays = cameras.pixel_rays(pixels, near, far)
    return share_cut_off(space, rays, LATEST * (rays.origins - target.to(rays.origins)).norm(dim=-1))


def _why_not(dataset: Dataset, least: int) -> str | None:
    """Return why rays should not start where `least` images look; None if they should."""
    scene, cameras, known = dataset.scene, dataset.cameras, dataset.sparse_depth
    if known is None and (scene.moving or scene.num_scenes > 1):
        return UNKNOWN
    space = SharedSpace(scene.box).to(dataset.device)
    space.leave_out(cameras, nearest_shown(dataset), least)
    if known is not None:
        some = known[evenly_spaced(len(known), TESTED_RAYS).to(known.pixels.device)]
        cut = share_cut_off(space, cameras.pixel_rays(some.pixels, scene.near, scene.far), some.distances)
        reason = f"{100 * cut:.2g} % of the points that they show are before where {least} photographs look"
        return None if cut <= MOST_CUT_OFF else reason
    late = share_late(space, cameras, scene.near, scene.far)
    if late is None:
        return f"the photographs look apart, and {UNKNOWN}"
    reason = (
        f"{100 * late:.2g} % of the rays reach what {least} photographs show only near what all look at, or behind it"
    )
    return None if late <= MOST_LATE else reason
