"""Sampling without a grid: uniform, by the inverse CDF of weights, or with proposals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from nerfloom.geometry.bounds import intersect_box
from nerfloom.geometry.rays import Rays, Samples
from nerfloom.kernels.histograms.inverse_cdf import inverse_cdf, uniform_variates
from nerfloom.plug_and_play.functions import DensityOnly, SigmaFunction, as_density, check_rays
from nerfloom.samplers.proposal import propose
from nerfloom.samplers.uniform import UniformSampler


def clip_to_box(rays: Rays, box: Tensor | Sequence[Sequence[float]]) -> Rays:
    """Clip rays to a box. A ray that misses the box gets equal near and far ends.

    Args:
        rays: R rays; near and far ends inside the box are kept.
        box: (2, 3) minimum and maximum corner.

    Raises:
        ValueError: if a shape is wrong, or the length of a direction is not 1.
    """
    check_rays(rays)
    corners = torch.as_tensor(box, dtype=rays.origins.dtype, device=rays.origins.device)
    enter, leave = intersect_box(rays.origins.detach(), rays.directions.detach(), corners)
    nears = torch.minimum(torch.maximum(enter, rays.nears), leave)
    return replace(rays, nears=nears, fars=torch.maximum(torch.minimum(leave, rays.fars), nears))


def sample_uniform(rays: Rays, count: int, *, jitter: bool = False) -> Samples:
    """Return samples in bins of equal length between near and far: NeRF (Mildenhall et al. 2020), equation 2.

    Args:
        rays: R rays with near and far ends.
        count: number of bins per ray, with one sample each.
        jitter: True for a random distance in each bin (training), False for its middle.

    Raises:
        ValueError: if a far end is infinite.
    """
    check_rays(rays)
    _check_ends(rays)
    return UniformSampler(count).sample(rays, DensityOnly(None), jitter)


def sample_inverse_cdf(rays: Rays, samples: Samples, weights: Tensor, count: int, *, jitter: bool = False) -> Samples:
    """Return the samples and further samples drawn from their weights: NeRF, section 5.2.

    The intervals of the result end halfway between neighbouring samples, and cover the ray from near to far.

    Args:
        rays: R rays with near and far ends.
        samples: S samples on each ray with adjacent intervals, as from `sample_uniform`.
        weights: (R * S,) weights of these samples, such as `Rendering.weights`; without a gradient.
        count: number of samples to draw on each ray.
        jitter: True for random samples (training), False for evenly spaced quantiles.

    Returns:
        S + count samples on each ray.

    Raises:
        ValueError: if rays have different numbers of samples, or a far end is infinite.
    """
    check_rays(rays)
    _check_ends(rays)
    edges = torch.cat([samples.padded(samples.t_starts), samples.padded(samples.t_ends)[:, -1:]], dim=-1)
    u = uniform_variates(len(rays), count, jitter, edges.device).to(edges.dtype)
    drawn = inverse_cdf(edges, samples.padded(weights.detach()), u)
    points = torch.cat([samples.padded(samples.t), drawn], dim=-1).sort(dim=-1).values
    between = (points[:, 1:] + points[:, :-1]) / 2
    edges = torch.cat([rays.nears[:, None], between, rays.fars[:, None]], dim=-1)
    return Samples.regular(edges[:, :-1], edges[:, 1:], points)


def sample_proposals(
    rays: Rays,
    sigma_fns: Sequence[SigmaFunction],
    counts: Sequence[int] = (128, 64, 32),
    *,
    jitter: bool = False,
    scale: float | None = None,
    power: float = 1.0,
) -> Samples:
    """Return samples drawn from the weights of proposals: mip-NeRF 360 (Barron et al. 2022), section 3.

    If gradients are enabled, the proposals' weights are attached to the result. To train the proposals, add
    `interlevel_loss(samples, weights)` to the loss, with the weights of the rendered samples.

    Args:
        rays: R rays with near and far ends; with a `scale`, far may be infinite. Samples have no gradient for rays.
        sigma_fns: density of each proposal level: (positions (N, 3)) -> sigma (N,), or (positions, times (N,)) -> sigma
            (N,) if the rays have times.
        counts: intervals per ray of each level, followed by the number of samples per ray: one count more than
            functions.
        jitter: True for random positions (training), False for fixed ones.
        scale: for an unbounded scene, samples are spaced linearly in distance up to this distance, and linearly in
            disparity beyond; None for linear spacing throughout.
        power: exponent of the weights before drawing; increase it from 0 to 1 in the first training steps.

    Raises:
        ValueError: if the number of counts does not fit the functions, or a far end is infinite without a `scale`.
    """
    check_rays(rays)
    if len(counts) != len(sigma_fns) + 1:
        raise ValueError(f"{len(counts)} counts for {len(sigma_fns)} proposals: give one count more than proposals")
    if scale is None:
        _check_ends(rays)
    densities = [as_density(sigma_fn) for sigma_fn in sigma_fns]
    learning = torch.is_grad_enabled()
    return propose(rays, densities, counts, scale, jitter=jitter, power=power, learning=learning)


def _check_ends(rays: Rays) -> None:
    """Check that every far end is finite; by default `Rays` have infinite far ends."""
    if bool(rays.fars.isinf().any()):
        raise ValueError("a ray has an infinite far end: give Rays its fars, or nerfloom.clip_to_box(rays, box)")
