"""Contraction of unbounded space into the unit cube, the domain of encodings."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from nerfloom.geometry.bounds import contract
from nerfloom.kernels import native, result_cache
from nerfloom.kernels.dispatch import CPP, TRITON, Operation
from nerfloom.kernels.triton_backend import later


def contract_to_unit_reference(positions: Tensor, box: Tensor) -> Tensor:
    """Compute `contract_to_unit` of `positions` and `box` in PyTorch, on any device and for any float type."""
    centre, half = (box[0] + box[1]) / 2, (box[1] - box[0]) / 2
    return contract((positions - centre) / half) / 4 + 0.5


def contract_to_unit(positions: Tensor, box: Tensor) -> Tensor:
    """Contract all of space into [0, 1]^3, where the ellipsoid inside `box` takes half of the width.

    mip-NeRF 360 (Barron et al. 2022), equation 10 (`nerfloom.geometry.bounds.contract`), scaled so that its ball of
    radius 2 fits into the cube.

    Args:
        positions: (N, 3) scene coordinates.
        box: (2, 3) corners of a box; space is contracted outside the ellipsoid that it encloses.

    Returns:
        (N, 3) positions in [0, 1].
    """
    return CONTRACT((positions, box), positions, box)


CONTRACT = Operation("contract_to_unit", contract_to_unit_reference)


@CONTRACT.implementation(CPP, differentiable=1)
def _compiled(positions: Tensor, box: Tensor) -> Tensor:
    return _Contract.apply(positions.contiguous(), box)


CONTRACT.implementation(TRITON, differentiable=1)(later("encodings.encodings_triton", "contract_to_unit"))


_forward = native.Function("contract_positions", "pppqpi")
_backward = native.Function("contract_positions_backward", "ppppqpi")


class _Contract(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, positions: Tensor, box: Tensor) -> Tensor:
        centre, scale = (box[0] + box[1]) / 2, 2 / (box[1] - box[0])

        def compute() -> Tensor:
            count, out = len(positions), torch.empty_like(positions)
            _forward(
                native.pointer(positions, "positions", (count, 3)), native.pointer(centre, "the centre", (3,)),
                native.pointer(scale, "the scale", (3,)), count, out.data_ptr(), native.threads(),
            )  # fmt: skip
            return out

        ctx.save_for_backward(positions, centre, scale)
        return result_cache.result(("contract_to_unit", *box.flatten().tolist()), (positions,), (), compute)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        positions, centre, scale = ctx.saved_tensors
        out, grad = torch.empty_like(positions), grad.contiguous()
        _backward(
            positions.data_ptr(), centre.data_ptr(), scale.data_ptr(), native.pointer(grad, "gradient", grad.shape),
            len(positions), out.data_ptr(), native.threads(),
        )  # fmt: skip
        return out, None
