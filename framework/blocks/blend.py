"""Pictures of several blocks blended into one: Block-NeRF (Tancik et al. 2022), section 4.3, "Compositing"."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from nerfloom.rendering.rendered import Picture

POWER = 4.0
"""Power of the inverse distance."""
MIN_VISIBILITY = 0.1
"""Minimum visibility of a block with a share, as a fraction of the best block's."""


def near_shares(distances: Tensor, radii: Tensor) -> Tensor:
    """Return the shares (B,) of blocks in a picture by the distance of its camera from their centres; they sum to 1.

    A share is proportional to (1 / distance - 1 / radius)^4, and 0 beyond the radius: the weights of Franke and
    Nielson (1980). Near the centre these are Block-NeRF's inverse distances to the power of 4. They fall to 0 at the
    radius, so pictures change continuously where a block enters or leaves. Beyond all radii, the block with the
    smallest ratio of distance to radius has the whole share.

    Args:
        distances: (B,) distances of the camera from the centres.
        radii: (B,) radii, positive.
    """
    closeness = (1 / torch.maximum(distances, 1e-9 * radii) - 1 / radii).clamp(min=0)
    largest = closeness.max()
    if not bool(largest > 0):
        closeness = torch.nn.functional.one_hot((distances / radii).argmin(), len(radii)).to(distances)
        largest = closeness.max()
    weights = (closeness / largest) ** POWER
    return weights / weights.sum()


def visible_shares(shares: Tensor, visibilities: Tensor) -> Tensor:
    """Return the shares (B,) of blocks, reduced where a block shows little; they sum to 1.

    A share is multiplied by how far the block's visibility, relative to the best one, is above `MIN_VISIBILITY`.

    Args:
        shares: (B,) shares by distance.
        visibilities: (B,) visibilities in [0, 1]; they have no effect for blocks without a share.
    """
    best = torch.where(shares > 0, visibilities, torch.zeros_like(visibilities)).max()
    if not bool(best > 0):
        return shares
    weights = shares * (visibilities / best - MIN_VISIBILITY).clamp(min=0)
    return weights / weights.sum()


def blended(pictures: Sequence[Picture], shares: Sequence[float]) -> Picture:
    """Return one picture of several `pictures`, of one size and unit of depth, by their `shares`, which sum to 1.

    Colour and opacity are means weighted by the shares. The depth is a mean weighted by share and opacity, and the
    median depth comes from the picture with the largest share, since a mean of two surfaces is none.
    """
    first = pictures[0].accumulation
    weights = torch.tensor(shares, dtype=first.dtype, device=first.device)[:, None, None]
    opacity = torch.stack([picture.accumulation for picture in pictures])
    depths = torch.stack([picture.depth for picture in pictures])
    colors = torch.stack([picture.rgb for picture in pictures])
    known = weights * opacity
    known = torch.where(known.sum(0) > 1e-6, known, weights.expand_as(known))
    return Picture(
        rgb=(weights[..., None] * colors).sum(0),
        depth=(known * depths).sum(0) / known.sum(0),
        median_depth=pictures[max(range(len(shares)), key=lambda number: shares[number])].median_depth,
        accumulation=(weights * opacity).sum(0),
        num_rays=sum(picture.num_rays for picture in pictures),
    )
