"""Speeds of matter near each time, from silhouettes alone: the slowest motion that is consistent with all of them.

An opaque pixel needs matter on its ray at the time of its image. If the assumed speed is too low, other images seem to
show that the whole ray is empty. So the speed is raised near the times of such images until no such ray is left. A
pixel in front of static matter gives no information, because that matter stays on its ray at any speed. So moving
matter must be seen beside static matter in some images.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from nerfloom.cameras.cameras import Cameras
from nerfloom.data.motion_bound import MotionBound
from nerfloom.geometry.bounds import intersect_box
from nerfloom.geometry.rays import Rays
from nerfloom.scene.moving_hulls import nearest
from nerfloom.scene.silhouettes import Silhouettes, held_balls

MIN_IMAGES, MIN_TIMES = 24, 8
"""Minimum number of images, and of distinct times; with fewer, no speed is estimated."""
MIN_SPEED = 0.25
"""First speed tried, in longest edges of the box per unit of time. Lower speeds save little."""
SPEED_RATIO = 2**0.5
"""Ratio of consecutive speeds tried."""
SAFETY_FACTOR = 2**0.5
"""Ratio of the speed used to the speed found. Pixels, balls and matter have a size, which makes the latter too low."""
RAISED_TIMES = 2
"""The speed is raised at this number of times before, and after, the time of an image with an unexplained ray."""
MAX_RAYS = 2**15
"""Maximum number of rays tested, spread evenly over all images."""
BALLS = 128
"""Number of balls along a row with the length of the box's diagonal."""


@torch.no_grad()
def motion_bound(silhouettes: Silhouettes, box: Tensor, times: Tensor) -> MotionBound | None:
    """Return how far matter may move, with `SAFETY_FACTOR`, by `silhouettes` at `times` (M,); None if too few.

    `box` (2, 3) has the minimum and maximum corner of the imaged scene.
    """
    silhouettes = silhouettes.closed_if_whole()
    images = silhouettes.at_full_size
    taken = times.cpu()[images].double()
    images, taken = [images[i] for i in taken.argsort(stable=True)], taken.sort(stable=True).values
    knots, which = taken.unique(return_inverse=True)
    if len(images) < MIN_IMAGES or len(knots) < MIN_TIMES:
        return None
    left = _rays_to_explain(silhouettes, images, box)
    spacing = float((box[1] - box[0]).norm()) / BALLS
    speeds = torch.full_like(knots, MIN_SPEED * float((box[1] - box[0]).max()))
    gaps = knots.diff()
    enough = float((box[1] - box[0]).norm()) / torch.minimum(torch.cat([gaps[:1], gaps]), torch.cat([gaps, gaps[-1:]]))
    while True:
        travelled = MotionBound.of(knots, speeds).at(taken)
        too_slow = torch.zeros_like(speeds, dtype=torch.bool)
        for number, rays in enumerate(left):
            left[number] = rays = rays[~_explained(silhouettes, images, number, rays, travelled, spacing)]
            if len(rays):
                middle = int(which[number])
                too_slow[max(middle - RAISED_TIMES, 0) : middle + RAISED_TIMES + 1] = True
        too_slow &= speeds < enough  # beyond this speed matter may be anywhere; motion does not explain the rest
        if not bool(too_slow.any()):
            return MotionBound.of(knots, SAFETY_FACTOR * speeds)
        speeds = torch.where(too_slow, SPEED_RATIO * speeds, speeds)


def _rays_to_explain(silhouettes: Silhouettes, images: Sequence[int], box: Tensor) -> list[Rays]:
    """Return the rays of each image that must meet matter, within the box: through opaque pixels at edges."""
    most, found = max(MAX_RAYS // len(images), 1), []
    cameras: Cameras = silhouettes.dataset.cameras
    for image in images:
        pixels = _edges(silhouettes, image).view(-1).nonzero().squeeze(-1)
        pixels = pixels[:: -(-len(pixels) // most) or 1]
        rays = cameras.pixel_rays(pixels + int(cameras.offsets[image]), 0.0, 1.0)
        meeting = Rays(rays.origins, rays.directions, *intersect_box(rays.origins, rays.directions, box))
        found.append(meeting[meeting.fars > meeting.nears])
    return found


def _balls(rays: Rays, spacing: float) -> tuple[Tensor, Tensor]:
    """Return centres (N, 3) of balls along the rays, `spacing` apart, and the index (N,) of each ball's ray."""
    count = int(((rays.fars - rays.nears) / spacing).ceil().max())
    positions = rays.nears[:, None] + spacing * (torch.arange(count, device=rays.nears.device) + 0.5)
    owners, steps = (positions < rays.fars[:, None] + spacing / 2).nonzero().unbind(1)
    along = positions[owners, steps, None] * rays.directions[owners]
    return (rays.origins[owners] + along).contiguous(), owners


def _edges(silhouettes: Silhouettes, image: int) -> Tensor:
    """Return the opaque pixels (H, W) bool of an image beside a transparent one.

    They show thin objects and the edges of others, which a wrong speed affects first.
    """
    sums, kept = silhouettes.sums[image], silhouettes.dataset.kept_of(image)
    opaque = sums.diff(dim=0).diff(dim=1) > 0
    clear = torch.nn.functional.pad(~opaque, (1, 1, 1, 1))
    edges = opaque & (clear[:-2, 1:-1] | clear[2:, 1:-1] | clear[1:-1, :-2] | clear[1:-1, 2:])
    return edges if kept is None else edges & kept.to(edges.device)


def _explained(
    silhouettes: Silhouettes, images: Sequence[int], number: int, rays: Rays, travelled: Tensor, spacing: float
) -> Tensor:
    """Return which rays (R,) bool of image `number` can meet matter, given the other images; `travelled` is (M,)."""
    if not len(rays):
        return torch.zeros(0, dtype=torch.bool)
    margins = (travelled - travelled[number]).abs()
    margins[number] = torch.inf
    near = [other for other in nearest(margins) if other != number]
    centers, owners = _balls(rays, spacing)
    held = held_balls(silhouettes, [images[i] for i in near], centers, spacing / 2, margins[near].tolist())
    explained = torch.zeros(len(rays), dtype=torch.bool)
    explained[owners[held]] = True
    return explained
