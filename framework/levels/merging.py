"""Merging of neighbouring Gaussians into one that replaces them in distant views.

Source: A Hierarchical 3D Gaussian Representation for Real-Time Rendering of Very Large Datasets (Kerbl et al. 2024,
arXiv:2406.12080), the generation of the hierarchy. With opacities o, surfaces S of the ellipsoids, means m and
covariances C, the weights of a group are w ~ o S, which sum to 1, and the merged Gaussian has

    m' = sum w m        C' = sum w (C + (m - m') (m - m')^T)        o' = sum o S / S'

Colours and harmonics are means with the same weights. Cauchy's formula: the projected area of a convex body is a
quarter of its surface, averaged over all directions. So o' keeps the coverage of the image, unless it would exceed 1:
then Gaussians overlap, and the merged one is opaque. The paper draws such Gaussians with a wider falloff instead.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from nerfloom.kernels.splats.project import rotation_matrices
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.ply import MAX_LOGIT
from nerfloom.splats.transform import quaternion

GROUP = 4
"""Number of Gaussians that one merged Gaussian stands for."""
KNUD_THOMSEN = 1.6075
"""Exponent of Knud Thomsen's formula of the surface of an ellipsoid; its relative error is at most 1.1 %."""
TINY = 1e-300
"""Lower limit of weights, surfaces and variances, which may underflow."""
FLAT = 1e-14
"""Lower limit of a variance of a merged Gaussian, as a fraction of its largest."""


def halved(gaussians: Gaussians, errors: Tensor) -> tuple[Gaussians, Tensor]:
    """Return about half as many Gaussians for the same space, and their errors.

    Gaussians near each other form groups of `GROUP`. Two thirds of the groups are merged: the ones that become
    smallest. The others stay as they are: large Gaussians, and those far from others.

    Args:
        gaussians: N Gaussians without further columns, all drawable.
        errors: (N,) error of each, in the unit of the centres; 0 if the Gaussian is not merged, else the largest
            standard deviation among itself and the merged Gaussians in it.

    Returns:
        M Gaussians and (M,) their errors; M is at most N / 2 for N of at least 8.
    """
    order = nearby_order(gaussians.means, GROUP)
    gaussians, errors = gaussians[order], errors[order]
    groups = len(gaussians) // GROUP
    if groups == 0:
        return gaussians, errors
    grouped = groups * GROUP
    fewer = merged(gaussians[:grouped], GROUP)
    sizes = torch.maximum(fewer.log_scales.exp().amax(1), errors[:grouped].view(groups, GROUP).amax(1))
    chosen = sizes.topk(min(groups, -(-len(gaussians) // 6)), largest=False).indices.sort().values
    stays = torch.ones(len(gaussians), dtype=torch.bool, device=errors.device)
    stays[:grouped].view(groups, GROUP)[chosen] = False
    return Gaussians.joined([gaussians[stays], fewer[chosen]]), torch.cat([errors[stays], sizes[chosen]])


def merged(gaussians: Gaussians, size: int) -> Gaussians:
    """Merge each `size` consecutive Gaussians into one, computed in float64.

    Args:
        gaussians: N Gaussians without further columns, all drawable; N is a multiple of `size`.

    Returns:
        N / `size` Gaussians.
    """
    groups, g = len(gaussians) // size, gaussians

    def grouped(values: Tensor) -> Tensor:
        return values.double().reshape(groups, size, *values.shape[1:])

    covered = torch.sigmoid(grouped(g.logits)) * grouped(surfaces(g.log_scales))
    weights = covered.clamp(min=TINY)
    weights = weights / weights.sum(1, keepdim=True)

    def mean(values: Tensor) -> Tensor:
        """Return the weighted mean over a group of values (groups, size, ...)."""
        return (weights.view(groups, size, *[1] * (values.ndim - 2)) * values).sum(1)

    means = mean(grouped(g.means))
    apart = grouped(g.means) - means[:, None]
    spread = mean(grouped(covariances(g)) + apart[..., None] * apart[..., None, :])
    variances, axes = torch.linalg.eigh(spread)
    variances = torch.maximum(variances, FLAT * variances[:, -1:]).clamp(min=TINY)
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]
    log_scales = variances.log() / 2
    opacity = covered.sum(1) / surfaces(log_scales).clamp(min=TINY)
    return Gaussians(
        means=means.to(g.means),
        log_scales=log_scales.to(g.log_scales),
        rotations=quaternion(axes).to(g.rotations),
        logits=torch.logit(opacity.clamp(max=1)).clamp(-MAX_LOGIT, MAX_LOGIT).to(g.logits),
        colors=mean(grouped(g.colors)).to(g.colors),
        harmonics=mean(grouped(g.harmonics)).to(g.harmonics),
    )


def surfaces(log_scales: Tensor) -> Tensor:
    """Return the surfaces (N,) float64 of ellipsoids by Knud Thomsen's formula.

    `log_scales` (N, 3) are the logarithms of the half axes.
    """
    a, b, c = log_scales.double().exp().unbind(-1)
    products = torch.stack([a * b, a * c, b * c], dim=-1)
    return 4 * math.pi * products.pow(KNUD_THOMSEN).mean(-1).pow(1 / KNUD_THOMSEN)


def covariances(gaussians: Gaussians) -> Tensor:
    """Return the covariances (N, 3, 3) float64 of N `gaussians`."""
    axes = rotation_matrices(gaussians.rotations.double()) * gaussians.log_scales.double().exp()[:, None]
    return axes @ axes.mT


def nearby_order(points: Tensor, size: int) -> Tensor:
    """Return an order (N,) of points with near points in each group of `size` consecutive ones.

    The points are halved across the longest side of their box, and so are the halves, down to groups of `size`.

    Args:
        points: (N, 3) finite positions.
        size: number of points in a group.
    """
    count, length = len(points), size
    while length < count:
        length *= 2
    # Positions at infinity fill up the last groups: they come last in every order.
    padded = torch.cat([points, points.new_full((length - count, 3), math.inf)])
    order = torch.arange(length, device=points.device)
    while length > size:
        rows = padded[order].view(-1, length, 3)
        sides = rows.masked_fill(rows.isinf(), -math.inf).amax(1) - rows.amin(1)
        axes = sides.argmax(-1)[:, None, None].expand(-1, length, 1)
        sorted_rows = rows.gather(2, axes)[..., 0].argsort(dim=1, stable=True)
        order = order.view(-1, length).gather(1, sorted_rows).flatten()
        length //= 2
    return order[order < count]
