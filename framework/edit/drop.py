"""Removal of single Gaussians: faint, large, needle-like or isolated ones, and floaters."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from nerfloom.edit.edited import Edited
from nerfloom.edit.sightings import sightings, training_views
from nerfloom.splats.start import neighbour_distance

OUTSIDE = 0.01
"""Share of the Gaussians, at both ends of each axis, that may miss some of their nearest neighbours."""


def drop_faint(edited: Edited, min_opacity: float = 0.02) -> Edited:
    """Remove Gaussians of lower opacity than `min_opacity`, 0 to 1."""
    return edited.kept(torch.sigmoid(edited.gaussians.logits) >= min_opacity)


def drop_large(edited: Edited, max_size: float) -> Edited:
    """Remove Gaussians with a larger standard deviation than `max_size` along any axis, in the unit of coordinates."""
    return edited.kept(edited.gaussians.log_scales.exp().amax(-1) <= max_size)


def drop_needles(edited: Edited, max_ratio: float = 20.0) -> Edited:
    """Remove Gaussians like needles, which show as spikes from other views.

    Args:
        max_ratio: maximum ratio of the longest axis to the second longest. Flat Gaussians have a small one.
    """
    sizes = edited.gaussians.log_scales.sort(-1).values
    return edited.kept(sizes[:, 2] - sizes[:, 1] <= math.log(max_ratio))


def drop_isolated(edited: Edited, neighbours: int = 8, max_ratio: float = 5.0) -> Edited:
    """Remove Gaussians far from others, in relation to their size: Gaussians of a far background are sparse, but large.

    Args:
        neighbours: number of nearest neighbours.
        max_ratio: maximum mean distance to them, relative to the median of all Gaussians or to the standard deviation
            along the longest axis, whichever is larger.
    """
    means, sizes = edited.gaussians.means, edited.gaussians.log_scales.exp().amax(-1)
    centred = (means - means.median(0).values).float()  # neighbours need no more precision
    distances = neighbour_distance(centred, neighbours, OUTSIDE)
    return edited.kept(distances <= max_ratio * torch.maximum(sizes, distances.median()))


def floating(edited: Edited, share: float = 0.5, max_opacity: float = 0.3, min_views: int = 3) -> Tensor:
    """Return the faint Gaussians that photographs see in front of the surfaces, (N,) bool on the CPU.

    A training image sees a Gaussian in front if it is nearer than 0.9 of the median depth in the pixel of its centre,
    or if that pixel has no surface.

    Args:
        share: minimum share of such images among the images that show it and nothing before it.
        max_opacity: maximum mean weight on its area in these images.
        min_views: minimum number of images that show it.

    Raises:
        ConfigError: if photographs are not known, or Gaussians cannot be drawn for their cameras.
    """
    loaded = edited.photographed("drop_floaters")
    seen = sightings(edited.in_scene(), training_views(loaded, edited.look))
    floats = (seen.views >= min_views) & (seen.in_front >= share * seen.views) & (seen.in_front > 0)
    return (floats & (seen.opacity_in_front <= max_opacity)).cpu()


def drop_floaters(edited: Edited, share: float = 0.5, max_opacity: float = 0.3, min_views: int = 3) -> Edited:
    """Remove faint Gaussians that photographs see in front of the surfaces, as `floating` returns them.

    Args:
        share, max_opacity, min_views: as in `floating`.

    Raises:
        ConfigError: as `floating`.
    """
    return edited.kept(~floating(edited, share, max_opacity, min_views))
