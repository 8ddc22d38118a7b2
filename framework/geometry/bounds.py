"""Boxes, their intersection with rays and unit coordinates; contraction of unbounded space and of Gaussians."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from nerfloom.geometry.limits import at_least


def intersect_box(origins: Tensor, directions: Tensor, box: Tensor) -> tuple[Tensor, Tensor]:
    """Return the distances where rays enter and leave an axis-aligned box (slab method, Kay and Kajiya 1986).

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


def half_edge(box: Tensor) -> float:
    """Return half the edge of the cube with the volume of `box` (2, 3): the `scale` of an unbounded scene."""
    return math.prod((box[1] - box[0]).tolist()) ** (1 / 3) / 2


def nested_boxes(box: Tensor, levels: int) -> Tensor:
    """Return boxes of the same centre, each with twice the edges of the one before: Instant-NGP, appendix E.2.

    Args:
        box: (2, 3) minimum and maximum corner of the smallest one, which is returned as it is.
        levels: number L of boxes.

    Returns:
        (L, 2, 3) corners.
    """
    half = (box[1] - box[0]) / 2
    grown = torch.tensor([2.0**level - 1 for level in range(levels)], dtype=box.dtype, device=box.device)
    return box + grown[:, None, None] * torch.stack([-half, half])


def cell_corners(cells: Tensor, resolution: int) -> Tensor:
    """Return the lower corners (K, 3) of `cells` (K,), in cells along x, y and z; (x, y, z) is (x n + y) n + z.

    n is the `resolution`, the number of cells along each axis.
    """
    return torch.stack([cells // resolution**2, cells // resolution % resolution, cells % resolution], dim=-1)


def box_around_cells(inside: Tensor, box: Tensor, margin: int = 0) -> Tensor | None:
    """Return the smallest box (2, 3) that holds some cells of a grid; None if there are none.

    Args:
        inside: (n, n, n) bool, True for these cells, indexed by x, y and z.
        box: (2, 3) minimum and maximum corner of the grid.
        margin: number of cells added on each side.
    """
    cells = inside.nonzero()
    if len(cells) == 0:
        return None
    ends = torch.stack([cells.amin(0) - margin, cells.amax(0) + 1 + margin])
    return torch.lerp(box[0], box[1], ends / len(inside))


def cubic_vertices(voxels: float, box: Tensor) -> tuple[int, ...]:
    """Return the vertices along each axis of a grid of about `voxels` cubes over a `box` (2, 3), at least 2."""
    size = (box[1] - box[0]).tolist()
    edge = (math.prod(size) / voxels) ** (1 / 3)
    return tuple(max(round(length / edge), 2) for length in size)


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
    unit, inverse = _inverted(positions)
    return unit * (2 - inverse)


def contract_gaussians(means: Tensor, roots: Tensor) -> tuple[Tensor, Tensor]:
    """Contract Gaussians by the derivative of the contraction at their means: mip-NeRF 360, equations 8 and 9.

    The derivative at x outside the unit ball is 1 / |x|^2 along x, and (2 - 1 / |x|) / |x| across it. It acts on roots
    of covariances rather than on covariances. So no variance can become negative, and far Gaussians keep their
    precision, although their variances differ by 20 orders of magnitude.

    Args:
        means: (N, 3) means.
        roots: (N, 3, K) roots F of the covariances F F^T.

    Returns:
        (N, 3) means with norm at most 2, and (N, 3, K) roots of the covariances there.
    """
    unit, inverse = _inverted(means)
    across = (2 - inverse) * inverse
    change = (inverse.square() - across) * (unit[:, :, None] * roots).sum(1)
    return unit * (2 - inverse), across[:, :, None] * roots + unit[:, :, None] * change[:, None]


def contraction_scale(positions: Tensor) -> Tensor:
    """Return the mean factors (...), over directions, of the contraction's scaling of lengths.

    It is the cube root of the determinant of the derivative of `contract` at `positions` (..., 3): 1 inside the unit
    ball, and falling with |x|^(-4/3) outside.
    """
    inverse = _inverted(positions)[1][..., 0]
    volume = (2 - inverse) * inverse.square()
    return volume.clamp(min=torch.finfo(volume.dtype).tiny) ** (2 / 3)  # at infinity it has a gradient too


def _inverted(positions: Tensor) -> tuple[Tensor, Tensor]:
    """Return x / max(1, |x|) and 1 / max(1, |x|) (..., 1), finite and with finite gradients for all `positions`."""
    limit = torch.finfo(positions.dtype).max
    finite = positions.clamp(-limit, limit)
    largest = (
        finite.detach().abs().amax(-1, keepdim=True).clamp(min=1)
    )  # detached: the result does not depend on the divisor
    scaled = finite / largest
    norm = at_least((scaled * scaled).sum(-1, keepdim=True), 1.0).sqrt()
    return scaled / norm, 1 / (largest * norm)
