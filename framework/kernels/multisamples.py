"""Multisamples of conical frustums in the unit cube of a grid: Zip-NeRF (Barron et al. 2023), section 3.

Letters: N frustums, J points in each.
"""

from __future__ import annotations

import torch
from torch import Tensor

from framework.geometry.bounds import contract, contraction_scale
from framework.geometry.multisamples import NUM_MULTISAMPLES, STD_SCALE, Pattern, multisamples
from framework.geometry.points import Frustums
from framework.kernels import native
from framework.kernels.dispatch import CPP, Operation


def unit_multisamples_reference(frustums: Frustums, pattern: Pattern, box: Tensor, contracted: bool) -> Tensor:
    """Compute `unit_multisamples` in PyTorch, on any device and for any float type.

    `frustums`, `pattern`, `box` and `contracted` are as in `unit_multisamples`.
    """
    positions, deviations = multisamples(frustums, pattern)
    half = (box[1] - box[0]) / 2
    x = (positions - (box[0] + box[1]) / 2) / half
    deviations = deviations.detach() / half.prod() ** (1 / 3)
    if contracted:
        deviations = deviations * contraction_scale(x.detach()) / 4
        x = contract(x) / 4 + 0.5
    else:
        deviations, x = deviations / 2, x / 2 + 0.5
    return torch.cat([x, deviations[..., None]], dim=-1)


def unit_multisamples(frustums: Frustums, pattern: Pattern, box: Tensor, contracted: bool) -> Tensor:
    """Return 6 points in each of N conical frustums, mapped to the unit cube, with their standard deviations.

    A deviation is scaled by the cube root of the determinant of the map's Jacobian (`bounds.contraction_scale`).

    Args:
        frustums: N frustums.
        pattern: how the points lie in each of them.
        box: (2, 3) corners of the scene's box.
        contracted: whether all of space is contracted into the cube, as `contract_to_unit` does; otherwise the box
            becomes the cube.

    Returns:
        (N, 6, 4) positions and isotropic standard deviations; no gradient goes through the deviations.
    """
    tensors = frustums.origins, frustums.directions, frustums.t_starts, frustums.t_ends, frustums.radii, box
    return UNIT_MULTISAMPLES((*tensors, *pattern), frustums, pattern, box, contracted)


UNIT_MULTISAMPLES = Operation("unit_multisamples", unit_multisamples_reference)


# Without a gradient, which only learnt poses need: then it is torch's.
@UNIT_MULTISAMPLES.implementation(CPP, differentiable=0)
def _compiled(frustums: Frustums, pattern: Pattern, box: Tensor, contracted: bool) -> Tensor:
    count, half = len(frustums), (box[1] - box[0]) / 2
    out = frustums.t_starts.new_empty(count, NUM_MULTISAMPLES, 4)
    # What is contracted is in half edges from the centre, everything else in edges from the corner.
    corner, scale = ((box[0] + box[1]) / 2, 1 / half) if contracted else (box[0].clone(), 0.5 / half)
    deviation = STD_SCALE / (half.prod() ** (1 / 3)).item() / (4 if contracted else 2)
    rows = [x.contiguous() for x in (frustums.origins, frustums.directions)]
    numbers = frustums.t_starts, frustums.t_ends, frustums.radii, pattern.turns.cos(), pattern.turns.sin()
    columns = [x.contiguous() for x in (*numbers, pattern.mirrors)]
    _multisamples(
        *(native.pointer(x, "rays", (count, 3)) for x in rows),
        *(native.pointer(x, "frustums", (count,)) for x in columns),
        count, native.pointer(corner, "the centre", (3,)), native.pointer(scale, "the scale", (3,)), deviation,
        int(contracted), out.data_ptr(), native.threads(),
    )  # fmt: skip
    return out


_multisamples = native.Function("multisamples", "ppppppppqppfipi")
