"""Chooses samples without a grid: evenly, by the inverse CDF of weights, or by proposals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from framework.geometry.bounds import intersect_box
from framework.geometry.rays import Rays, Samples
from framework.samplers.inverse_cdf import inverse_cdf, uniform_variates
from framework.samplers.proposal import propose
from framework.samplers.uniform import UniformSampler
from nerfloom.functions import DensityOnly, SigmaFunction, as_density, check_rays


def clip_to_box(rays: Rays, box: Tensor | Sequence[Sequence[float]]) -> Rays:
    """Clip rays to where they enter and leave a box; a ray that misses it gets length 0.

    Args:
        rays: R rays, near and far ends being kept where they are inside.
        box: (2, 3) smallest and largest corner.
    """
    check_rays(rays)
    corners = torch.as_tensor(box, dtype=rays.origins.dtype, device=rays.origins.device)
    enter, leave = intersect_box(rays.origins.detach(), rays.directions.detach(), corners)
    nears = torch.minimum(torch.maximum(enter, rays.nears), leave)
    return replace(rays, nears=nears, fars=torch.maximum(torch.minimum(leave, rays.fars), nears))


def sample_uniform(rays: Rays, count: int, *, jitter: bool = False) -> Samples:
    """Sample rays in bins of equal length between near and far: NeRF (Mildenhall et al. 2020), equation 2.

    Args:
        rays: R rays with near and far ends.
        count: bins a ray.
        jitter: at a random distance in each bin (training), or in its middle.
    Raises: ValueError where a far end is infinite.
    """
    check_rays(rays)
    _check_ends(rays)
    return UniformSampler(count).sample(rays, DensityOnly(None), jitter)


def sample_inverse_cdf(rays: Rays, samples: Samples, weights: Tensor, count: int, *, jitter: bool = False) -> Samples:
    """Add `count` samples to each ray where the weights are: NeRF, section 5.2.

    Each stands for what is nearer to it than to the others, so that they share the ray from near to far between them.

    Args:
        rays: R rays with near and far ends.
        samples: S samples on each ray whose intervals follow one another, as from `sample_uniform`.
        weights: (R * S,) of their intervals, such as `Rendering.weights`; without a gradient.
        count: samples to draw on each ray.
        jitter: drawn at random (training), or at even quantiles.
    Raises: ValueError where rays have different numbers of samples, or a far end is infinite.
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
    """Sample rays where small density fields propose it: mip-NeRF 360 (Barron et al. 2022), section 3.

    With gradients enabled the proposals' own are attached to the result: add `interlevel_loss(samples, weights)`, of
    the weights that were rendered, to the loss, and they learn to bound these from above.

    Args:
        rays: R rays with near and far ends; far may be infinite with a `scale`. Samples have no gradient to rays.
        sigma_fns: of each level but the last, (positions (N, 3)) -> sigma (N,), and where rays have times
            (positions, times (N,)).
        counts: intervals a ray of each level, then samples: one more than there are functions.
        jitter: random positions (training), or fixed ones.
        scale: of an unbounded scene, the distance up to which normalised distance is even, being in disparity beyond;
            None for even ones throughout.
        power: which weights are raised to before they are drawn by: from 0 to 1 over the first steps, proposals come
            to be believed.
    Raises: ValueError where counts do not fit the functions, or a far end is infinite without a `scale`.
    """
    check_rays(rays)
    if len(counts) != len(sigma_fns) + 1:
        raise ValueError(f"{len(counts)} counts for {len(sigma_fns)} proposals: one more is needed")
    if scale is None:
        _check_ends(rays)
    densities = [as_density(sigma_fn) for sigma_fn in sigma_fns]
    learning = torch.is_grad_enabled()
    return propose(rays, densities, counts, scale, jitter=jitter, power=power, learning=learning, endless=False)


def _check_ends(rays: Rays) -> None:
    """Check that no ray's far end is infinite, which it is if it was not given."""
    if bool(rays.fars.isinf().any()):
        raise ValueError("a ray ends nowhere: give Rays its fars, or nerfloom.clip_to_box(rays, box)")
