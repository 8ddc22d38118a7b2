"""Spacing of intervals along rays: from normalised distance to distance, by disparity or a power ladder.

Intervals are drawn in normalised distance s in [0, 1], from the near to the far end of a ray. In a bounded scene s is
linear in the distance. In an unbounded scene it is linear up to half the edge of the box and linear in disparity
beyond, or it follows Zip-NeRF's power ladder (Barron et al. 2023).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from nerfloom.geometry.limits import at_least
from nerfloom.kernels import native
from nerfloom.kernels.dispatch import CPP, Operation

LADDER_PREMULTIPLIER = 2.0
"""Factor of distances, in units of the scene's scale, before the power ladder (Zip-NeRF)."""


def spacing(
    nears: Tensor, fars: Tensor, scale: float | None, ladder: float | None = None
) -> Callable[[Tensor], Tensor]:
    """Return the function from normalised distances (R, B) in [0, 1] to distances (R, B) along rays, scene units.

    Args:
        nears, fars: (R,) distances of the rays' ends, which correspond to 0 and 1.
        scale: distance up to which normalised distance is linear; beyond, it is linear in disparity. None if it is
            linear throughout.
        ladder: exponent of a power ladder instead of disparity, applied to twice the distance in units of `scale`;
            Zip-NeRF uses -1.5. It is linear near the camera as well, and bends gradually.
    """
    if scale is None or ladder is None:
        return lambda edges: SPACED((edges, nears, fars), edges, nears, fars, scale)
    unit, power = scale / LADDER_PREMULTIPLIER, ladder
    near, far = (power_ladder(t / unit, power)[:, None] for t in (nears, fars))
    return lambda edges: unit * inverse_power_ladder(torch.lerp(near, far, edges), power)


def to_disparity(t: Tensor) -> Tensor:
    """Map distances `t` in [0, inf) to [0, 1): t / 2 up to t = 1, and 1 - 1 / (2 t) beyond."""
    return torch.where(t < 1, t / 2, 1 - 1 / (2 * at_least(t, 1.0)))


def from_disparity(s: Tensor) -> Tensor:
    """Map `s` in [0, 1] to distances: the inverse of `to_disparity`, with a large, finite result at s = 1."""
    tiny = torch.finfo(s.dtype).eps
    return torch.where(s < 0.5, 2 * s, 1 / (2 - 2 * s).clamp(min=tiny))


def power_ladder(x: Tensor, power: float) -> Tensor:
    """Map distances `x` in [0, inf] by |p - 1| / p ((x / |p - 1| + 1)^p - 1), with a slope of 1 at 0: Zip-NeRF.

    It is x for p = 1, log(1 + x) for p = 0, x / (1 + x / 2) for p = -1, and is bounded for p < 0.

    Args:
        x: distances, at least 0.
        power: exponent p, at most 1.

    Raises:
        ValueError: if the exponent is above 1.
    """
    if power > 1:
        raise ValueError(f"a power ladder's exponent is at most 1, not {power}")
    if power in (0, 1):
        return x if power else torch.log1p(x)
    rest = 1 - power
    return (rest / power) * torch.expm1(power * torch.log1p(x / rest))


def inverse_power_ladder(y: Tensor, power: float) -> Tensor:
    """Return the inverse of `power_ladder` at `y`; large but finite where the ladder is bounded.

    Args:
        y: values of the ladder.
        power: exponent p, at most 1.
    """
    if power in (0, 1):
        return y if power else torch.expm1(y)
    rest = 1 - power
    least = torch.finfo(y.dtype).eps - 1
    return rest * torch.expm1(torch.log1p((y * (power / rest)).clamp(min=least)) / power)


def spaced_reference(edges: Tensor, nears: Tensor, fars: Tensor, scale: float | None) -> Tensor:
    """Compute `spacing` of `edges` (R, B) between `nears` and `fars`, with a `scale` and no ladder, in PyTorch."""
    if scale is None:
        return torch.lerp(nears[:, None], fars[:, None], edges)
    near, far = (to_disparity(t / scale)[:, None] for t in (nears, fars))
    return scale * from_disparity(torch.lerp(near, far, edges))


SPACED = Operation("spaced", spaced_reference)


@SPACED.implementation(CPP, order=0)
def _compiled(edges: Tensor, nears: Tensor, fars: Tensor, scale: float | None) -> Tensor:
    edges, nears, fars = edges.contiguous(), nears.contiguous(), fars.contiguous()
    out = torch.empty_like(edges)
    rays, count = edges.shape
    _spaced(
        native.pointer(edges, "edges", (rays, count)), native.pointer(nears, "near ends", (rays,)),
        native.pointer(fars, "far ends", (rays,)), rays, count, 0.0 if scale is None else scale, out.data_ptr(),
        native.threads(),
    )  # fmt: skip
    return out


_spaced = native.Function("spaced_distances", "pppqqfpi")
