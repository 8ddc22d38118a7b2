"""Boxes: their intersection with rays, unit coordinates, and the contraction of unbounded space."""

from __future__ import annotations

import torch
from torch import Tensor


def intersect_box(origins: Tensor, directions: Tensor, box: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distances at which rays enter and leave an axis-aligned box (slab method, Kay and Kajiya 1986).

    A ray parallel to a face is inside or outside that slab along its whole length; a ray that starts inside the box
    enters at 0. For a ray that misses the box, or only touches it, both distances are 0: an interval of length 0.

    Args:
        origins, directions: (R, 3).
        box: (2, 3) minimum and maximum corner.

    Returns:
        enter (R,) and leave (R,), with 0 <= enter <= leave.
    """
    parallel = directions == 0
    safe = torch.where(parallel, torch.ones_like(directions), directions)
    low, high = (box[0] - origins) / safe, (box[1] - origins) / safe
    enter, leave = torch.minimum(low, high), torch.maximum(low, high)
    inside_slab = (origins >= box[0]) & (origins <= box[1])
    infinity = torch.full_like(enter, torch.inf)
    enter = torch.where(parallel, torch.where(inside_slab, -infinity, infinity), enter)
    leave = torch.where(parallel, torch.where(inside_slab, infinity, -infinity), leave)
    enter, leave = enter.amax(-1).clamp(min=0), leave.amin(-1)
    hit = leave > enter
    zero = torch.zeros_like(enter)
    return torch.where(hit, enter, zero), torch.where(hit, leave, zero)


def to_unit_box(positions: Tensor, box: Tensor) -> Tensor:
    """Map positions from a box to the unit cube.

    Args:
        positions: (N, 3) scene coordinates.
        box: (2, 3) minimum and maximum corner.

    Returns:
        (N, 3), in [0, 1]^3 for positions inside the box.
    """
    return (positions - box[0]) / (box[1] - box[0])


def contract(positions: Tensor) -> Tensor:
    """Map all of space into the ball of radius 2: x inside the unit ball, (2 - 1/|x|) x/|x| outside.

    mip-NeRF 360 (Barron et al. 2022), equation 10. Far from the origin, x is divided by its largest coordinate before
    it is squared, so that the norm stays finite; max(1, |x|) keeps value and gradient finite at the origin. Infinite
    coordinates are replaced by the largest finite number.

    Args:
        positions: (..., 3).

    Returns:
        (..., 3) with norm at most 2.
    """
    limit = torch.finfo(positions.dtype).max
    finite = positions.clamp(-limit, limit)
    largest = (
        finite.detach().abs().amax(-1, keepdim=True).clamp(min=1)
    )  # detached: the result does not depend on the divisor
    scaled = finite / largest
    norm = (scaled * scaled).sum(-1, keepdim=True).clamp(min=1).sqrt()
    return scaled * ((2 - 1 / (largest * norm)) / norm)


def contraction_scale(positions: Tensor) -> Tensor:
    """Return the factor by which `contract` scales a small isotropic Gaussian at each position.

    It is the cube root of the determinant of the contraction's Jacobian: Zip-NeRF (Barron et al. 2023), section 2. With
    n = |x| > 1 the Jacobian's eigenvalues are 1 / n^2 along x and, twice, (2 - 1/n) / n across it.

    Args:
        positions: (..., 3).

    Returns:
        (...) factors in [0, 1], 1 inside the unit ball.
    """
    limit = torch.finfo(positions.dtype).max ** 0.45  # the norm's square stays finite
    inverse = 1 / positions.clamp(-limit, limit).norm(dim=-1).clamp(min=1)
    return (inverse * inverse * (2 - inverse)) ** (2 / 3)
