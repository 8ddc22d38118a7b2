"""Multisamples: a few points in a conical frustum that stand for all of it (Zip-NeRF, Barron et al. 2023, section 2).

Six points lie on a helix around the axis of the cone. Their mean, their variance along the axis and the sum of their
variances across it equal the frustum's exactly, however the pattern is rotated. Their covariance equals the frustum's
on average over all rotations. If a frustum is much longer than its distance, its last point lies beyond its end, by at
most 3.4 % of its length.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from nerfloom.geometry.points import Frustums, frames, radii_at

THIRDS_OF_PI = (0, 2, 4, 3, 5, 1)
"""Angle of each point around the axis, from the near end to the far one, in units of pi / 3."""
NUM_MULTISAMPLES = len(THIRDS_OF_PI)
"""Number of points in a frustum."""
STD_SCALE = 0.5
"""Standard deviation of a point, relative to its distance from the axis (`sigma` in the paper)."""

SCATTER = 0x9E3779B1 - 2**32
"""Factor of the bits of a float that are hashed: 2^32 over the golden ratio (Knuth 1973, section 6.4), as an int32."""


class Pattern(NamedTuple):
    """Rotations and mirrorings of the pattern of points in N frustums."""

    turns: Tensor
    """(N,) angle of its rotation around the axis."""
    mirrors: Tensor
    """(N,) -1 where it is mirrored, 1 elsewhere."""


def hashed_pattern(frustums: Frustums) -> Pattern:
    """Return pseudo-random rotations for training; half of the patterns are mirrored.

    The rotation is a hash of both ends of a frustum, which are random themselves. Equal frustums have equal rotations,
    so values that a march has computed in waves are not computed again (`kernels.result_cache`).

    Args:
        frustums: N frustums.
    """
    start, end = (t.detach().float().contiguous().view(torch.int32) for t in (frustums.t_starts, frustums.t_ends))
    bits = (start * SCATTER + end) * SCATTER  # products wrap around, as hashes do; the upper bits change most
    u = ((bits >> 8) & (2**24 - 1)).to(frustums.radii) * 2.0**-24
    mirrored = (u >= 0.5).to(u)
    return Pattern((2 * u - mirrored) * math.tau, 1 - 2 * mirrored)  # one number for both


def fixed_pattern(frustums: Frustums) -> Pattern:
    """Return the pattern for evaluation: every second frustum on a ray is mirrored and rotated by 30 degrees.

    Args:
        frustums: N frustums; without ranks, no frustum is mirrored or rotated.
    """
    if frustums.ranks is None:
        return Pattern(torch.zeros_like(frustums.radii), torch.ones_like(frustums.radii))
    odd = (frustums.ranks % 2).to(frustums.radii)
    return Pattern(odd * (math.pi / 6), 1 - 2 * odd)


def multisamples(frustums: Frustums, pattern: Pattern) -> tuple[Tensor, Tensor]:
    """Return 6 points in each frustum, with the standard deviation of an isotropic Gaussian at each.

    Zip-NeRF (arXiv:2304.06706), equations 1 and 2, in a form that does not overflow for intervals without end.

    Args:
        frustums: N frustums.
        pattern: how the pattern lies in each of them.

    Returns:
        (N, 6, 3) positions, near to far, and (N, 6) standard deviations, scene units.
    """
    start, end = frustums.t_starts[:, None], frustums.t_ends[:, None]
    middle, half = (start + end) / 2, (end - start) / 2
    positive = middle > 0
    share = torch.where(positive, half / torch.where(positive, middle, torch.ones_like(middle)), 0.0)
    if frustums.parallel:  # the apex is infinitely far away
        share = torch.zeros_like(share)
    squared = share.square()
    along = torch.linspace(-1, 1, NUM_MULTISAMPLES, dtype=start.dtype, device=start.device)
    spread = (3 / math.sqrt(7)) * along * ((squared - 1).square() + 4).sqrt()
    t = start + half * ((1 + share).square() + 2 + spread) / (squared + 3)
    angles = _angles(along.dtype, along.device) + pattern.turns[:, None]
    away = radii_at(t, frustums.radii[:, None], frustums.parallel).expand_as(t) / math.sqrt(2)
    _, first, second = frames(frustums.directions).unbind(-1)
    positions = torch.addcmul(frustums.origins[:, None], t[..., None], frustums.directions[:, None])
    positions = torch.addcmul(positions, (away * angles.cos())[..., None], first[:, None])
    positions = torch.addcmul(positions, (away * angles.sin() * pattern.mirrors[:, None])[..., None], second[:, None])
    return positions, STD_SCALE * away


@lru_cache(maxsize=8)
def _angles(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the angles (6,) of the points; cached, because a copy to the device waits for it."""
    return torch.tensor(THIRDS_OF_PI, dtype=dtype, device=device) * (math.pi / 3)
