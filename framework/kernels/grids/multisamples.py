"""Conical frustums in the unit cube of a grid, each as six points or as one ball: Zip-NeRF (Barron et al. 2023).

Letters: N frustums, J points in each.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from nerfloom.geometry.bounds import contract, contraction_scale
from nerfloom.geometry.multisamples import NUM_MULTISAMPLES, STD_SCALE, Pattern, multisamples
from nerfloom.geometry.points import Frustums, conical_frustums
from nerfloom.kernels import native
from nerfloom.kernels.dispatch import CPP, Operation


def unit_multisamples_reference(frustums: Frustums, pattern: Pattern, box: Tensor, contracted: bool) -> Tensor:
    """Compute `unit_multisamples` of `frustums`, `pattern`, `box` and `contracted` in PyTorch, for any float type."""
    return unit_balls(*multisamples(frustums, pattern), box, contracted)


def unit_balls(positions: Tensor, deviations: Tensor, box: Tensor, contracted: bool) -> Tensor:
    """Map isotropic Gaussians to the unit cube, in PyTorch.

    Args:
        positions: (..., 3) means, scene coordinates.
        deviations: (...) standard deviations, scene units; without a gradient.
        box, contracted: as in `unit_multisamples`.

    Returns:
        (..., 4) positions and standard deviations.
    """
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
        pattern: arrangement of the points in each frustum.
        box: (2, 3) corners of the scene's box.
        contracted: whether all of space is contracted into the cube, as in `contract_to_unit`; otherwise the box
            becomes the cube.

    Returns:
        (N, 6, 4) positions and isotropic standard deviations; the deviations have no gradient.
    """
    tensors = frustums.origins, frustums.directions, frustums.t_starts, frustums.t_ends, frustums.radii, box
    return UNIT_MULTISAMPLES((*tensors, *pattern), frustums, pattern, box, contracted)


UNIT_MULTISAMPLES = Operation("unit_multisamples", unit_multisamples_reference)


@UNIT_MULTISAMPLES.implementation(
    CPP, differentiable=2, fits=lambda frustums, pattern, box, contracted: not frustums.parallel
)
def _compiled(frustums: Frustums, pattern: Pattern, box: Tensor, contracted: bool) -> Tensor:
    turned = pattern.turns.cos(), pattern.turns.sin(), pattern.mirrors
    kernels, row = (_multisamples, _multisamples_backward), (NUM_MULTISAMPLES, 4)
    columns = (*_columns(frustums), *turned)
    to_cube = _Map.of(box, contracted, STD_SCALE)
    return _InCube.apply(frustums.origins, frustums.directions, columns, row, to_cube, kernels)


def frustum_balls_reference(frustums: Frustums, box: Tensor, contracted: bool) -> Tensor:
    """Compute `frustum_balls` of `frustums`, `box` and `contracted` in PyTorch, on any device, for any float type."""
    mean_t, along, across = conical_frustums(frustums.t_starts, frustums.t_ends, frustums.radii, frustums.parallel)
    positions = torch.addcmul(frustums.origins, frustums.directions, mean_t[:, None])
    return unit_balls(positions, ball_deviations(along, across), box, contracted)


def ball_deviations(along: Tensor, across: Tensor) -> Tensor:
    """Return the standard deviation (N,) of balls with the volume of given Gaussians.

    Args:
        along, across: (N,) variance along an axis and across it.
    """
    return torch.exp((along.log() + 2 * across.log()) / 6)  # the product would be too small for float32


def frustum_balls(frustums: Frustums, box: Tensor, contracted: bool) -> Tensor:
    """Return a ball for each of N conical frustums, mapped to the unit cube, with its standard deviation.

    It is the isotropic Gaussian with the mean and the volume of the frustum's Gaussian (Mip-NeRF, equation 7). Its
    deviation is scaled by the cube root of the determinant of the map's Jacobian (`bounds.contraction_scale`).

    Args:
        frustums: N frustums.
        box: (2, 3) corners of the scene's box.
        contracted: whether all of space is contracted into the cube, as in `unit_multisamples`.

    Returns:
        (N, 4) positions and standard deviations; the deviations have no gradient.
    """
    tensors = frustums.origins, frustums.directions, frustums.t_starts, frustums.t_ends, frustums.radii, box
    return FRUSTUM_BALLS(tensors, frustums, box, contracted)


FRUSTUM_BALLS = Operation("frustum_balls", frustum_balls_reference)


@FRUSTUM_BALLS.implementation(CPP, differentiable=2, fits=lambda frustums, box, contracted: not frustums.parallel)
def _compiled_balls(frustums: Frustums, box: Tensor, contracted: bool) -> Tensor:
    kernels, to_cube = (_balls, _balls_backward), _Map.of(box, contracted, 1.0)
    return _InCube.apply(frustums.origins, frustums.directions, _columns(frustums), (4,), to_cube, kernels)


def _columns(frustums: Frustums) -> tuple[Tensor, ...]:
    return frustums.t_starts, frustums.t_ends, frustums.radii


class _Map(NamedTuple):
    """The map from the scene to the unit cube, and the factor of deviations."""

    centre: Tensor
    scale: Tensor
    deviation: float
    contracted: bool

    @classmethod
    def of(cls, box: Tensor, contracted: bool, deviation: float) -> _Map:
        half = (box[1] - box[0]) / 2
        # Contracted positions are in half edges from the centre, all others in edges from the corner.
        centre, scale = ((box[0] + box[1]) / 2, 1 / half) if contracted else (box[0].clone(), 0.5 / half)
        smaller = (half.prod() ** (1 / 3)).item() * (4 if contracted else 2)
        return cls(centre, scale, deviation / smaller, contracted)

    def addresses(self) -> tuple[int, int]:
        return native.pointer(self.centre, "the centre", (3,)), native.pointer(self.scale, "the scale", (3,))


def _addresses(count: int, origins: Tensor, directions: Tensor, *columns: Tensor) -> list[int]:
    """Return the addresses of the description of N = `count` frustums: (N, 3) rays, and numbers (N,)."""
    rows = [native.pointer(x, "rays", (count, 3)) for x in (origins, directions)]
    return rows + [native.pointer(x, "frustums", (count,)) for x in columns]


class _InCube(torch.autograd.Function):
    """Points and balls for N frustums in the unit cube, with the gradient by the rays of the frustums."""

    @staticmethod
    def forward(
        ctx: Any, origins: Tensor, directions: Tensor, columns: tuple[Tensor, ...], row: tuple[int, ...], to_cube: _Map,
        kernels: tuple[native.Function, native.Function],
    ) -> Tensor:  # fmt: skip
        count, tensors = len(origins), [x.contiguous() for x in (origins, directions, *columns)]
        out = origins.new_empty(count, *row)
        kernels[0](
            *_addresses(count, *tensors), count, *to_cube.addresses(), to_cube.deviation, int(to_cube.contracted),
            out.data_ptr(), native.threads(),
        )  # fmt: skip
        ctx.save_for_backward(*tensors)
        ctx.to_cube, ctx.kernels = to_cube, kernels
        return out

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        tensors, to_cube, grad = ctx.saved_tensors, ctx.to_cube, grad.contiguous()
        by_origins, by_directions = (torch.empty_like(x) for x in tensors[:2])
        ctx.kernels[1](
            *_addresses(len(grad), *tensors), len(grad), *to_cube.addresses(), int(to_cube.contracted),
            grad.data_ptr(), by_origins.data_ptr(), by_directions.data_ptr(), native.threads(),
        )  # fmt: skip
        return by_origins, by_directions, None, None, None, None


_multisamples = native.Function("multisamples", "ppppppppqppfipi")
_multisamples_backward = native.Function("multisamples_backward", "ppppppppqppipppi")
_balls = native.Function("frustum_balls", "pppppqppfipi")
_balls_backward = native.Function("frustum_balls_backward", "pppppqppipppi")
