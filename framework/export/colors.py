"""Colours of vertices, rendered from just in front of the surface."""

from __future__ import annotations

import torch
from torch import Tensor

from nerfloom.geometry.rays import Rays
from nerfloom.renderable import RendersRays

REACH = 3.0
"""Length of a ray before the surface and behind it, in cells."""
OPAQUE = 0.1
"""Minimum opacity of a ray with a known colour."""
GREY = 0.5
"""Colour of a mesh if no vertex has a colour."""
CHUNK = 2**15
"""Number of rays that are rendered at once."""


@torch.no_grad()
def seen_colors(model: RendersRays, vertices: Tensor, normals: Tensor, spacing: float, time: float) -> Tensor:
    """Return the colours (V, 3) of vertices, each by a short ray against its normal; NaN where it meets nothing.

    Like a camera's ray, each ray crosses the surface, and its colour is the weighted mean of the field's colours. The
    field's colour at the vertex itself, at the edge of the matter, differs from the images.

    Args:
        model: the model in evaluation mode.
        vertices: (V, 3) scene coordinates.
        normals: (V, 3) unit normals.
        spacing: edge of a cell, scene units.
        time: time in [0, 1] of a scene that moves.
    """
    background, reach, device = model.background, REACH * spacing, model.device
    found = []
    for places, outwards in zip(vertices.float().split(CHUNK), normals.float().split(CHUNK), strict=True):
        count = len(places)
        # Not along an axis: such rays run in the faces of cells.
        directions = -outwards.to(device)
        rays = Rays(
            origins=(places.to(device) - reach * directions).contiguous(),
            directions=directions.contiguous(),
            nears=torch.zeros(count, device=device),
            fars=torch.full((count,), 2 * reach, device=device),
            pixel_radii=torch.full((count,), 0.25, device=device),
            times=torch.full((count,), time, device=device) if model.scene.moving else None,
        )
        with model.rendering():
            rendered = model.render(rays, background)
        opacity = rendered.accumulation.float()[:, None]
        color = (rendered.rgb.float() - (1 - opacity) * background) / opacity.clamp(min=OPAQUE)
        found.append(torch.where(opacity >= OPAQUE, color.clamp(0, 1), torch.nan).cpu())
    return torch.cat(found)


def spread_colors(colors: Tensor, faces: Tensor) -> Tensor:
    """Return colours (V, 3); vertices without colour get the mean colour of their neighbours.

    Colours spread along edges until no vertex can be reached. Points that none reaches have the mean of all.

    Args:
        colors: (V, 3), NaN for a vertex without.
        faces: (F, 3) indices of vertices.
    """
    colors = colors.clone()
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = torch.cat([edges, edges.flip(-1)])
    while True:
        known = ~colors.isnan().any(-1)
        edges = edges[~known[edges[:, 0]]]  # to a vertex without colour
        chosen = edges[known[edges[:, 1]]]
        if not len(chosen):
            break
        total, count = torch.zeros_like(colors), torch.zeros(len(colors))
        total.index_add_(0, chosen[:, 0], colors[chosen[:, 1]])
        count.index_add_(0, chosen[:, 0], torch.ones(len(chosen)))
        reached = count > 0
        colors[reached] = total[reached] / count[reached, None]
    known = ~colors.isnan().any(-1)
    colors[~known] = colors[known].mean(0) if bool(known.any()) else GREY
    return colors
