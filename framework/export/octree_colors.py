"""Colours of an octree's leaves: visibility in the training images, and harmonics fitted to the colours seen there."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.console import track
from nerfloom.base.evenly_spaced import strided
from nerfloom.cameras.cameras import Cameras
from nerfloom.data.pixels.pixel_set import PixelSet
from nerfloom.fields.base import Field
from nerfloom.geometry.points import Points
from nerfloom.kernels.encodings.spherical_harmonics import spherical_harmonics
from nerfloom.kernels.octree.layout import OctreeLayout
from nerfloom.kernels.octree.packed import PackedLeaves
from nerfloom.kernels.octree.weights import raise_weights
from nerfloom.ray_model import RayModel

MAX_VIEWS = 48
"""Maximum number of cameras to fit colours from."""
DIRECTIONS = {0: 4, 1: 8, 2: 14, 3: 24}
"""Number of directions for the field's colour of a leaf, by the degree of its harmonics."""
RIDGE = 0.03
"""Penalty of harmonics that depend on the direction, relative to the sum of the weights, because directions are few."""
LEAVES_AT_ONCE = 2**14
"""Number of leaves with colours evaluated together."""
STOP = 1e-3
"""Rays end below this transmittance."""
RAYS_AT_ONCE = 2**18
"""Rays that are traced together."""
Colors = Callable[[Tensor, Tensor], Tensor]
"""Function from B leaves (B,) int64 and unit directions (B, D, 3) to the colours (B, D, 3) seen there, on the CPU."""


@dataclass(frozen=True)
class Seen:
    """Visibility of the L leaves of an octree in the training images."""

    largest: Tensor
    """(L,) largest weight on any ray."""
    by_view: Tensor
    """(L, V) uint8 largest weight in each of V images, times 255."""
    positions: Tensor
    """(V, 3) positions of their cameras."""
    pixels: PixelSet
    """Pixels, of all images, with rays that meet a leaf."""

    def part(self, kept: Tensor) -> Seen:
        """Return the visibility of the leaves `kept` (N,) int64."""
        return replace(self, largest=self.largest[kept], by_view=self.by_view[kept])


@torch.no_grad()
def seen_leaves(layout: OctreeLayout, raw: Tensor, cameras: Cameras, near: float, far: float) -> Seen:
    """Return how images see the leaves of an octree. Each pixel's ray is traced once.

    Args:
        layout: where the L leaves are.
        raw: (L, 1) raw densities, as in `trace_octree`.
        cameras: M training cameras.
        near, far: distances where rays start and end.
    """
    count, largest = len(cameras), torch.zeros(layout.num_leaves)
    chosen = strided(count, MAX_VIEWS)
    by_view = torch.zeros(layout.num_leaves, len(chosen), dtype=torch.uint8)
    sets = []
    for index in track(range(count), "Looking at leaves", total=count):
        weights, hit = torch.zeros(layout.num_leaves), []
        for pixels in cameras.image_pixels(index).split(RAYS_AT_ONCE):
            hit.append(raise_weights(layout, raw, cameras.pixel_rays(pixels, near, far), weights, STOP) > 0)
        torch.maximum(largest, weights, out=largest)
        sets.append(PixelSet.of_mask(torch.cat(hit), cameras.ends[index]))
        if index in chosen:
            by_view[:, chosen.index(index)] = (255 * weights).round().to(torch.uint8)
    return Seen(largest, by_view, cameras.camera_to_worlds[chosen, :, 3], PixelSet.joined(sets))


@torch.no_grad()
def fitted_colors(colors: Colors, centers: Tensor, seen: Seen, degree: int) -> Tensor:
    """Return coefficients (L, 3 K) of harmonics: weighted least squares, leaf by leaf, to colours.

    Each leaf's colour is evaluated in the directions of the cameras that see it best.

    Args:
        colors: the colours, of a field or of other harmonics.
        centers: (L, 3) centres of the leaves.
        seen: how training images see the leaves; the fit uses its weights.
        degree: degree of the harmonics, 0 to 3.
    """
    out = torch.zeros(len(centers), 3 * (degree + 1) ** 2)
    parts = torch.arange(len(centers)).split(LEAVES_AT_ONCE)
    for part in track(parts, "Fitting colours", total=len(parts)):
        weights, order = seen.by_view[part].float().topk(min(DIRECTIONS[degree], seen.by_view.shape[1]))
        away = centers[part, None] - seen.positions[order]
        directions = torch.nn.functional.normalize(away, dim=-1)
        out[part] = fitted(directions, colors(part, directions), weights + 1e-3, degree)
    return out


def field_colors(model: RayModel[Any], centers: Tensor, size: float) -> Colors:
    """Return the colours of a field in leaves.

    Args:
        model: the model in evaluation mode.
        centers: (L, 3) centres of the leaves.
        size: edge of a leaf, scene units.
    """

    def colors(leaves: Tensor, directions: Tensor) -> Tensor:
        with model.rendering():
            return _colors(model.field, centers[leaves].to(model.device), directions.to(model.device), size).cpu()

    return colors


def leaf_colors(leaves: PackedLeaves) -> Colors:
    """Return the colours of an octree's own `leaves`, on the CPU."""
    terms = leaves.colors.shape[1] // 3

    def colors(chosen: Tensor, directions: Tensor) -> Tensor:
        basis = spherical_harmonics(directions.reshape(-1, 3).contiguous(), math.isqrt(terms))
        coefficients = leaves.colors[chosen].float() * leaves.scales + leaves.offsets
        return torch.einsum("bdk,bck->bdc", basis.view(len(chosen), -1, terms), coefficients.view(-1, 3, terms))

    return colors


def _colors(field: Field, positions: Tensor, directions: Tensor, size: float) -> Tensor:
    """Return the field's colours (B, D, 3) at positions (B, 3) in directions (B, D, 3)."""
    count, number = directions.shape[:2]
    points = Points(positions, None, torch.full((count,), size / 2, device=positions.device)).sized(size / 12**0.5)
    features = field.density(points)[1]
    repeated = features.repeat_interleave(number, 0)
    return field.color(repeated, directions.reshape(-1, 3)).float().view(count, number, 3)


def fitted(directions: Tensor, colors: Tensor, weights: Tensor, degree: int) -> Tensor:
    """Return coefficients (B, 3 K) that minimise the weighted squared error of colours in some directions.

    Args:
        directions: (B, D, 3) unit vectors.
        colors: (B, D, 3) colours seen in these directions.
        weights: (B, D) weights of the errors.
        degree: degree of the harmonics, 0 to 3.
    """
    count, number = weights.shape
    basis = spherical_harmonics(directions.reshape(-1, 3).contiguous(), degree + 1).view(count, number, -1)
    share = weights / weights.sum(-1, keepdim=True)
    weighted = (basis * share[..., None]).transpose(1, 2)
    ridge = torch.full((basis.shape[-1],), RIDGE)
    ridge[0] = 0
    normal = weighted @ basis + torch.diag(ridge)
    return torch.linalg.solve(normal, weighted @ colors).transpose(1, 2).reshape(count, -1)
