"""The largest weight of each leaf of an octree; it is 0 for leaves that no image shows."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.geometry.rays import Rays
from nerfloom.kernels import native
from nerfloom.kernels.compositing.density import exclusive_sum, ray_sum
from nerfloom.kernels.dispatch import CPP, TRITON, Operation
from nerfloom.kernels.octree.layout import OctreeLayout
from nerfloom.kernels.octree.light import LAYOUT, RAYS, contiguous, depths_of, ray_arguments
from nerfloom.kernels.octree.walk import leaf_samples
from nerfloom.kernels.triton_backend import later

_weights = native.Function("octree_weights", LAYOUT + "pq" + RAYS + "fppi")


def raise_weights(layout: OctreeLayout, raw: Tensor, rays: Rays, weights: Tensor, stop: float = 0.0) -> Tensor:
    """Raise each leaf's weight, in place, to its largest on R rays, and return the opacity (R,) of the rays.

    Args:
        layout: where the L leaves are.
        raw: (L, 1) raw densities, as in `trace_octree`.
        weights: (L,) largest weights so far.
        stop: transmittance below which a ray ends.
    """
    return RAISE_WEIGHTS((raw, rays.origins, weights), layout, raw, rays, weights, stop)


@torch.no_grad()
def raise_weights_reference(
    layout: OctreeLayout, raw: Tensor, rays: Rays, weights: Tensor, stop: float = 0.0
) -> Tensor:
    """Compute `raise_weights` in PyTorch; `layout`, `raw`, `rays`, `weights` and `stop` are as there."""
    samples, leaves = leaf_samples(layout, rays)
    tau = depths_of(raw[leaves, 0]) * samples.deltas / layout.edges_of(leaves, samples.deltas.dtype)
    through = torch.exp(-exclusive_sum(tau, samples))
    found = torch.where(through >= stop, through * -torch.expm1(-tau), torch.zeros_like(tau))
    weights.scatter_reduce_(0, leaves, found.to(weights), "amax")
    return ray_sum(found, samples)


RAISE_WEIGHTS: Operation[..., Tensor] = Operation("raise_weights", raise_weights_reference)


@RAISE_WEIGHTS.implementation(CPP, order=0)
def _raise_weights(layout: OctreeLayout, raw: Tensor, rays: Rays, weights: Tensor, stop: float = 0.0) -> Tensor:
    count, opacity = layout.num_leaves, rays.fars.new_empty(len(rays))
    rays = contiguous(rays)  # kept until the call returns: its addresses are passed
    _weights(
        *layout.arguments(), native.pointer(raw, "raw densities", (count, 1)), count,
        *ray_arguments(rays), stop, native.pointer(weights, "weights", (count,)), opacity.data_ptr(),
        native.threads(),
    )  # fmt: skip
    return opacity


RAISE_WEIGHTS.implementation(TRITON, order=0)(later("octree.trace_triton", "raise_weights"))
