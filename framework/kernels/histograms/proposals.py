"""Weights of a proposal along rays, in one compiled call.

A proposal is a small network on a hash grid. Its density is evaluated in many intervals of each ray, only to draw the
intervals of the next level from its weights. In single operations most intermediate values (positions, their
contraction, features, outputs) are written to memory and read once. The compiled form processes a block of rays in
cache (`proposals.cpp`). In steps where the proposal learns, it also writes the values that the backward pass needs.
"""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.geometry.rays import Rays
from nerfloom.kernels import native, result_cache
from nerfloom.kernels.argument_checks import is_followed
from nerfloom.kernels.dispatch import CPP, Operation
from nerfloom.kernels.grids.hash_grid import hash_grid
from nerfloom.kernels.histograms.intervals import interval_weights
from nerfloom.kernels.networks.mlp import density_mlp, multiplies_bf16
from nerfloom.kernels.traced.trace import DENSITY, GridDensity, density_arguments, has_compiled_parts


def proposal_weights(rays: Rays, t: Tensor, density: GridDensity) -> Tensor:
    """Return the weights (R, B) of intervals along rays, from the density in the middle of each.

    Args:
        rays: R rays; they get no gradient.
        t: (R, B + 1) sorted distances that bound the intervals; without a gradient.
        density: the proposal.
    """
    rays, t = rays.detached(), t.detach()
    return PROPOSAL_WEIGHTS((rays.origins, rays.directions, t, density.table, *density.weights), rays, t, density)


def proposal_weights_reference(rays: Rays, t: Tensor, density: GridDensity) -> Tensor:
    """Compute `proposal_weights` of `rays`, `t` and `density` operation by operation, on any device."""
    middles = (t[:, 1:] + t[:, :-1]) / 2
    positions = torch.addcmul(rays.origins[:, None], rays.directions[:, None], middles[..., None])
    sigma, _ = density.at(positions.flatten(0, 1))
    return interval_weights(sigma.view(middles.shape), t)


PROPOSAL_WEIGHTS = Operation("proposal_weights", proposal_weights_reference)


def _fits(rays: Rays, t: Tensor, density: GridDensity) -> bool:
    return t.shape[1] > 1 and has_compiled_parts(rays.origins, density)


@PROPOSAL_WEIGHTS.implementation(CPP, fits=_fits)
def _compiled(rays: Rays, t: Tensor, density: GridDensity) -> Tensor:
    count, bins, follows = len(rays), t.shape[1] - 1, is_followed(density.table, *density.weights)
    origins, directions, t = rays.origins.contiguous(), rays.directions.contiguous(), t.contiguous()
    weights = None if follows else torch.empty(count, bins)
    sizes = [(3,), (density.weights[0].shape[1],), (density.weights[-1].shape[0],), ()] if follows else []
    saved = [torch.empty(count * bins, *size) for size in sizes]
    where: list[int | None] = [each.data_ptr() for each in saved]
    _proposal_weights(
        native.pointer(origins, "origins", (count, 3)), native.pointer(directions, "directions", (count, 3)),
        native.pointer(t, "distances", (count, bins + 1)), count, bins, *density_arguments(density), multiplies_bf16(),
        None if weights is None else weights.data_ptr(), *(where or [None] * 4),
        native.threads(),
    )  # fmt: skip
    if weights is not None:
        return weights
    unit, encoded, outputs, sigma = saved
    with result_cache.given(hash_grid=encoded, mlp=outputs, density=sigma):  # these operations add their gradients
        sigma, _ = density_mlp((hash_grid(unit, density.table, density.layout, density.deferred),), density.weights)
    return interval_weights(sigma.view(count, bins), t)


_proposal_weights = native.Function("proposal_weights", "pppqq" + DENSITY + "ipppppi")
