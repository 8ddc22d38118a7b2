"""Decision whether rays start at the near plane, or only where several training images look."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.config import TrainConfig
from nerfloom.base.decisions import Decision, is_open
from nerfloom.base.evenly_spaced import evenly_spaced
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.poses import looked_at
from nerfloom.data.dataset import Dataset
from nerfloom.data.free_space import before_points
from nerfloom.method import SHARED_BY
from nerfloom.scene.covisible_space import CovisibleSpace, share_cut_off

MAX_CUT_OFF = 0.002
"""Maximum fraction of a reconstruction's points that late ray starts may cut off."""
NEAREST_CONTENT, MAX_LATE = 0.8, 0.02
"""Without points: assumed distance of the nearest content, as a fraction of the distance to the point that all cameras
look at, and the maximum fraction of rays that may start behind it."""
TESTED_RAYS = 20_000
"""Number of tested rays."""
NOTHING_TO_TEST = "no points say whether anything is cut off"
"""Reason to start at the near plane if nothing can be tested."""


def starts_checked(
    config: TrainConfig, settings: Any, made: list[Decision], dataset: Dataset
) -> tuple[Any, list[Decision]]:
    """Let rays start at the near plane if late starts would cut off content.

    The cells are coarse if cameras stand close together right in front of the scene. In LLFF's fern they cut off 9 % of
    the points on rays, which costs 2 dB. The points of a reconstruction show this. Without points, the rays' starts are
    compared with the point that all cameras look at: in fern they lie behind it, in captures around an object well
    before it.

    Args:
        settings: the same settings after the method's decisions.
        made: the method's decisions.
        dataset: the training images.

    Returns:
        The settings and the decisions.
    """
    scene, chosen = dataset.scene, is_open(config.rays_shared_by) and settings.rays_shared_by
    nested = settings.sampler == "occupancy" and settings.background_model == "contraction"  # boxes skip by themselves
    if not chosen or not scene.unbounded or scene.warped or nested:
        return settings, made
    reason = _why_not(dataset, chosen)
    if reason is None:
        return settings, made
    started = Decision("rays start", "at their near ends", f"{reason} (else: --rays-shared-by {SHARED_BY})")
    return replace(settings, rays_shared_by=0), [*made, started]


def nearest_shown(dataset: Dataset) -> Tensor:
    """Return the distance (M,) from each of M cameras that its image in `dataset` shows to be empty, by its points."""
    near = torch.full_like(dataset.cameras.fx, dataset.scene.near)
    return near if dataset.sparse_depth is None else near.maximum(before_points(dataset.cameras, dataset.sparse_depth))


@torch.no_grad()
def share_late(space: CovisibleSpace, cameras: Cameras, near: float, far: float) -> float | None:
    """Return the fraction of the pixels' rays that start close to the point that all cameras look at, or behind it.

    Close means beyond `NEAREST_CONTENT` of the distance to the point nearest to all optical axes.

    Args:
        space: cells where no ray starts.
        cameras: M cameras.
        near, far: near and far distance of the rays, scene units.

    Returns:
        A fraction in [0, 1]; None if the cameras look at no common point.
    """
    target = looked_at(cameras.camera_to_worlds)
    if target is None:
        return None
    pixels = evenly_spaced(int(cameras.offsets[-1]), TESTED_RAYS).to(cameras.fx.device)
    rays = cameras.pixel_rays(pixels, near, far)
    return share_cut_off(space, rays, NEAREST_CONTENT * (rays.origins - target.to(rays.origins)).norm(dim=-1))


def _why_not(dataset: Dataset, least: int) -> str | None:
    """Return why rays should not start where `least` images look; None if they should."""
    scene, cameras, known = dataset.scene, dataset.cameras, dataset.sparse_depth
    if known is None and (scene.moving or scene.num_scenes > 1):
        return NOTHING_TO_TEST
    space = CovisibleSpace(scene.box).to(dataset.device)
    space.exclude(cameras, nearest_shown(dataset), least)
    if known is not None:
        some = known[evenly_spaced(len(known), TESTED_RAYS).to(known.pixels.device)]
        cut = share_cut_off(space, cameras.pixel_rays(some.pixels, scene.near, scene.far), some.distances)
        reason = f"{100 * cut:.2g} % of the points lie before the space that {least} photographs show"
        return None if cut <= MAX_CUT_OFF else reason
    late = share_late(space, cameras, scene.near, scene.far)
    if late is None:
        return f"the photographs look apart, and {NOTHING_TO_TEST}"
    reason = (
        f"{100 * late:.2g} % of the rays reach space that {least} photographs show only close to the point that all "
        "cameras look at, or behind it"
    )
    return None if late <= MAX_LATE else reason
