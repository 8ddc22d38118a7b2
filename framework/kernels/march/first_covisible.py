"""The first position along a ray that enough images show, from the excluded cells (`scene/covisible_space.py`)."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.geometry.rays import Rays
from nerfloom.kernels import native
from nerfloom.kernels.dispatch import CPP, Operation

LEVELS, CELLS = 3, 32
"""Number of nested boxes, each twice as large as the one before, and of cells along an axis; the rest is covisible."""
STEPS, REACH, PARTS = 64, 4.0, 16
"""Number of positions tested along a ray; distance of the last one from the near end, in half edges of the box; and
number of parts of the step before the first covisible position, tested in turn."""


@torch.no_grad()
def first_covisible_reference(rays: Rays, box: Tensor, excluded: Tensor) -> Tensor:
    """Compute `first_covisible` of `rays`, `box` and `excluded` in PyTorch, on any device and for any float type."""
    half = (box[1] - box[0]).amax() / 2
    ends = torch.minimum(rays.nears + REACH * half, rays.fars)
    steps = torch.linspace(0, 1, STEPS, device=ends.device, dtype=ends.dtype)
    t = torch.lerp(rays.nears[:, None], ends[:, None], steps)

    def covisible(t: Tensor) -> Tensor:
        positions = torch.addcmul(rays.origins[:, None], rays.directions[:, None], t[..., None])
        return ~excluded[_cells(positions.view(-1, 3), box)].view(t.shape)

    first = covisible(t).int().argmax(1, keepdim=True)  # index 0 if there is no other
    # Otherwise up to a whole step of visible space would be skipped.
    parts = torch.linspace(1 / PARTS, 1, PARTS, device=ends.device, dtype=ends.dtype)
    within = torch.lerp(t.gather(1, (first - 1).clamp(min=0)), t.gather(1, first), parts)
    return within.gather(1, covisible(within).int().argmax(1, keepdim=True)).squeeze(1)


def _cells(positions: Tensor, box: Tensor) -> Tensor:
    """Return the index (N,) of the smallest box's cell around each of `positions` (N, 3); the last is beyond."""
    unit = (positions - box.mean(0)) / ((box[1] - box[0]) / 2)
    level = unit.abs().amax(-1).clamp(min=1).log2().ceil().clamp(max=LEVELS)
    x, y, z = ((unit * torch.exp2(-level)[:, None] + 1) * (CELLS / 2)).long().clamp(0, CELLS - 1).unbind(-1)
    return (((level.long() * CELLS + x) * CELLS + y) * CELLS + z).clamp(max=LEVELS * CELLS**3)


def first_covisible(rays: Rays, box: Tensor, excluded: Tensor) -> Tensor:
    """Return the distance (R,) of the first covisible position along each ray; its near end if there is none.

    Args:
        rays: R rays; they get no gradient.
        box: (2, 3) corners of the smallest box, scene units.
        excluded: (`LEVELS` * `CELLS`^3 + 1,) bool, box by box; the last entry stands for all space beyond the boxes and
            is False.
    """
    rays = rays.detached()
    return FIRST_COVISIBLE((rays.origins, rays.directions, rays.nears, rays.fars, box), rays, box, excluded)


FIRST_COVISIBLE = Operation("first_covisible", first_covisible_reference)


@FIRST_COVISIBLE.implementation(CPP)
def _compiled(rays: Rays, box: Tensor, excluded: Tensor) -> Tensor:
    count, out = len(rays), torch.empty_like(rays.nears)
    origins, directions, nears, fars = (
        each.contiguous() for each in (rays.origins, rays.directions, rays.nears, rays.fars)
    )
    _first_covisible(
        native.pointer(origins, "origins", (count, 3)), native.pointer(directions, "directions", (count, 3)),
        native.pointer(nears, "near ends", (count,)), native.pointer(fars, "far ends", (count,)), count,
        native.pointer(box, "the box", (2, 3)),
        native.pointer(excluded, "cells", (LEVELS * CELLS**3 + 1,), torch.bool), LEVELS, CELLS, STEPS, REACH, PARTS,
        out.data_ptr(), native.threads(),
    )  # fmt: skip
    return out


_first_covisible = native.Function("first_covisible", "ppppqppiiifipi")
