"""Real spherical harmonics of up to 4 bands: Instant-NGP (Mueller et al. 2022), section 5.4.

The constants are those of Sloan 2008, "Stupid spherical harmonics tricks", appendix A2, with the Condon-Shortley phase.
"""

from __future__ import annotations

import torch
from torch import Tensor

from framework.kernels import kept, native
from framework.kernels.dispatch import CPP, TRITON, Operation
from framework.kernels.triton_kernels import later

MAX_LEVELS = 4
"""Maximum number of bands."""
_harmonics = native.Function("spherical_harmonics", "pqipi")


def spherical_harmonics(directions: Tensor, levels: int = 4) -> Tensor:
    """Return the first real spherical harmonics Y_l^m of directions, ordered by l = 0, 1, ... and m = -l ... l.

    The compiled form has no derivatives.

    Args:
        directions: (N, 3) unit vectors.
        levels: number of bands, 1 to 4, which papers call the degree.

    Returns:
        (N, levels^2) values of functions that are orthonormal over the sphere.

    Raises:
        ValueError: if the number of levels is out of range.
    """
    if not 1 <= levels <= MAX_LEVELS:
        raise ValueError(f"spherical harmonics have 1 to {MAX_LEVELS} levels, not {levels}")
    return SPHERICAL_HARMONICS((directions,), directions, levels)


def spherical_harmonics_reference(directions: Tensor, levels: int = 4) -> Tensor:
    """Compute `spherical_harmonics` of `directions` and `levels` in PyTorch, for any float type, with derivatives."""
    x, y, z = directions.unbind(-1)
    bands = [torch.full_like(x, 0.28209479177387814)]
    if levels > 1:
        bands += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if levels > 2:
        bands += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (3 * z * z - 1),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (x * x - y * y),
        ]
    if levels > 3:
        bands += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (5 * z * z - 1),
            0.3731763325901154 * z * (5 * z * z - 3),
            -0.4570457994644658 * x * (5 * z * z - 1),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    return torch.stack(bands, dim=-1)


SPHERICAL_HARMONICS = Operation("spherical_harmonics", spherical_harmonics_reference)


@SPHERICAL_HARMONICS.implementation(CPP, order=0)
def _compiled(directions: Tensor, levels: int = 4) -> Tensor:
    rows = directions.contiguous()

    def compute() -> Tensor:
        out = rows.new_empty(len(rows), levels**2)
        address = native.pointer(rows, "directions", (len(rows), 3))
        _harmonics(address, len(rows), levels, out.data_ptr(), native.threads())
        return out

    return kept.result(("spherical_harmonics", levels), (rows,), (), compute)


SPHERICAL_HARMONICS.implementation(TRITON, order=0)(later("encodings", "spherical_harmonics"))
