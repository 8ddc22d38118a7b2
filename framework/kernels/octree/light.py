"""Light along rays through the leaves of an octree.

Density and colour are constant in a leaf, so a ray's integral is exact (Max 1995; NeRF, Mildenhall et al. 2020,
equation 3). With the length l_i of a ray in leaf i, and c_i the leaf's harmonics in the ray's direction:

    tau_i = sigma_i * l_i,    T_i = exp(-sum_{j < i} tau_j),    w_i = T_i * (1 - exp(-tau_i))
    C = sum_i w_i c_i + (1 - sum_i w_i) * background

A colour is linear in a leaf's coefficients, as in Plenoxels (Fridovich-Keil et al. 2022) without its clamp: it is
clamped once, in the finished pixel. So coefficients are summed along a ray, and meet the harmonics of its direction
once. A ray ends when T is below `stop`: matter behind this point shows as background. A leaf's channel is at most |c|
(degree + 1) / sqrt(4 pi), where |c| is the norm of its coefficients (Cauchy-Schwarz and Unsoeld's theorem); so the
error of a channel is at most `stop` times the sum of this bound and the background (`error_bound`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from nerfloom.geometry.rays import Rays
from nerfloom.kernels import native
from nerfloom.kernels.compositing.density import exclusive_sum, ray_sum
from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics_reference
from nerfloom.kernels.octree.layout import OctreeLayout
from nerfloom.kernels.octree.walk import leaf_samples

MAX_DEGREE = 3
"""Maximum degree of the harmonics."""
LAYOUT, RAYS = "ifpppppp", "ppppq"
"""Types of the arguments of compiled functions that describe an octree, and rays."""


class OctreeLight(NamedTuple):
    """Light of R rays."""

    color: Tensor
    """(R, 3) colour over the background, not clamped."""
    opacity: Tensor
    """(R,) sum of the weights."""
    moment: Tensor
    """(R,) sum of weight * t, t in the middle of each leaf; without gradient."""
    median: Tensor
    """(R,) distance where the transmittance is 0.5, or the far end; without gradient."""
    visits: Tensor
    """(R,) int32 number of leaves that a ray meets before it ends."""


def depths_of(raw: Tensor) -> Tensor:
    """Return optical depths of cells' edges: exp(raw - 1) up to raw = 1, and raw beyond, so that they are positive.

    It is the activation of SVRaster (Sun et al. 2025) without its sharper slope.

    Args:
        raw: raw densities of any shape.
    """
    return torch.where(raw > 1, raw, torch.exp(raw.clamp(max=1) - 1))


def raw_of(depths: Tensor) -> Tensor:
    """Return the raw densities of optical `depths` of any shape: the inverse of `depths_of`."""
    return torch.where(depths > 1, depths, 1 + torch.log(depths.clamp(1e-9, 1)))


def light_of(
    layout: OctreeLayout, depths: Tensor, coefficients: Tensor, rays: Rays, background: Tensor, stop: float,
    peaks: Tensor | None = None, smallest: Tensor | None = None,
) -> OctreeLight:  # fmt: skip
    """Compute the light of rays in PyTorch, with the walk of `walk.py` and autograd's gradient.

    Args:
        layout: where the L leaves are.
        depths: (L,) optical depth of a cell's edge in each leaf.
        coefficients: (L, 3 K) coefficients of the leaves.
        rays: R rays; the other tensors have their type.
        background: (R, 3) colour of the background.
        stop: transmittance below which a ray ends.
        peaks: (L,) largest weight of each leaf so far, raised in place; None for none.
        smallest: (R,) smallest edge of cells, per unit of distance, as in `leaf_samples`.
    """
    samples, leaves = leaf_samples(layout, rays, smallest)
    tau = depths[leaves] * samples.deltas / layout.edges_of(leaves, samples.deltas.dtype)
    through = torch.exp(-exclusive_sum(tau, samples))
    weights = through * -torch.expm1(-tau)
    weights = torch.where(through >= stop, weights, torch.zeros_like(weights))
    values = coefficients.shape[1] // 3
    basis = spherical_harmonics_reference(rays.directions, math.isqrt(values))
    sums = ray_sum(weights[:, None] * coefficients[leaves], samples).view(-1, 3, values)
    opacity = ray_sum(weights, samples)
    color = (sums * basis[:, None]).sum(-1) + (1 - opacity)[:, None] * background
    with torch.no_grad():
        moment = ray_sum(weights * (samples.t_starts + samples.t_ends) / 2, samples)
        crosses = (weights > 0) & (through - weights <= 0.5) & (through > 0.5)
        within = torch.log(2 * through) / tau.clamp(min=torch.finfo(tau.dtype).tiny)
        place = torch.where(crosses, samples.t_starts + samples.deltas * within, torch.inf)
        fars = rays.fars.to(color.dtype)
        median = fars.scatter_reduce(0, samples.ray_indices, place.to(fars), "amin")
        visits = torch.bincount(samples.ray_indices[~(through < stop)], minlength=len(rays)).int()
        if peaks is not None:
            peaks.scatter_reduce_(0, leaves, weights.to(peaks), "amax")
    return OctreeLight(color, opacity, moment, median, visits)


def check_leaves(layout: OctreeLayout, raw: Tensor, coefficients: Tensor) -> None:
    """Check that leaves have the numbers of values that kernels rely on.

    Args:
        layout: where the L leaves are.
        raw: (L, ...) their densities.
        coefficients: (L, 3 K) their coefficients.

    Raises:
        ValueError: if there are not L of each, or K is not 1, 4, 9 or 16.
    """
    count = layout.num_leaves
    if len(raw) != count or len(coefficients) != count:
        raise ValueError(f"there are {count} leaves, and values of {len(raw)} and {len(coefficients)}")
    if coefficients.shape[1] not in [3 * (degree + 1) ** 2 for degree in range(MAX_DEGREE + 1)]:
        raise ValueError(f"leaves have {coefficients.shape[1]} coefficients; they must have 3, 12, 27 or 48")


def error_bound(coefficients: Tensor, stop: float) -> float:
    """Return the maximum error of a colour channel of rays that end at a transmittance, over backgrounds in [0, 1].

    Args:
        coefficients: (L, 3 K) coefficients of the leaves.
        stop: transmittance below which rays end.
    """
    if not len(coefficients):
        return 0.0
    values = coefficients.shape[1] // 3
    largest = float(coefficients.reshape(-1, 3, values).norm(dim=-1).max())
    return stop * (largest * math.sqrt(values / (4 * math.pi)) + 1)


def ray_arguments(rays: Rays) -> tuple[Any, ...]:
    """Check the arguments of compiled functions that describe `rays`, and return them."""
    count = len(rays)
    return (
        native.pointer(rays.origins, "origins", (count, 3)), native.pointer(rays.directions, "directions", (count, 3)),
        native.pointer(rays.nears, "near ends", (count,)), native.pointer(rays.fars, "far ends", (count,)), count,
    )  # fmt: skip


def contiguous(rays: Rays) -> Rays:
    """Return origins, directions and ends of `rays`, contiguous and without gradient."""
    fields = (rays.origins, rays.directions, rays.nears, rays.fars)
    origins, directions, nears, fars = (values.detach().contiguous() for values in fields)
    return Rays(origins, directions, nears, fars)


def outputs_of(rays: Rays) -> tuple[OctreeLight, tuple[int, ...]]:
    """Return the light of `rays` for a compiled function to fill in, and the addresses of its tensors."""
    count, new = len(rays), rays.fars.new_empty
    out = OctreeLight(new(count, 3), new(count), new(count), new(count), new(count, dtype=torch.int32))
    return out, tuple(values.data_ptr() for values in out)
