"""Bilateral grids of affine functions of colours, which vary smoothly with position and brightness.

Wang, Wang, Gong and Xue, "Bilateral Guided Radiance Field Processing", SIGGRAPH 2024 (arXiv:2406.00448), section 3; the
grid is from Chen, Paris and Durand 2007. An affine function is interpolated trilinearly at the pixel's position and
at the luminance of its colour. A penalty on the grid's total variation makes it smooth.
"""

from __future__ import annotations

from itertools import product

import torch
from torch import Tensor
from torch.nn import functional


def luminance(colors: Tensor) -> Tensor:
    """Return the luminance (...) of display colours (..., 3), as in the paper: Rec. 601's.

    Args:
        colors: (..., 3) display colours.
    """
    return 0.299 * colors[..., 0] + 0.587 * colors[..., 1] + 0.114 * colors[..., 2]


def sliced(grids: Tensor, images: Tensor, places: Tensor, guide: Tensor) -> Tensor:
    """Return the values of grids at points, interpolated between the eight vertices around each.

    The first and the last vertex of an axis are at 0 and 1; points outside have the values of the nearest inside.

    Args:
        grids: (M, L, H, W, C) grids of M images: levels of luminance, rows, columns, and C values. Each axis has two
            vertices or more.
        images: (N,) int64, image of each point.
        places: (N, 2) position in the image from its left and top edge, 0 to 1.
        guide: (N,) luminance.

    Returns:
        (N, C) values.
    """
    levels, rows, columns, channels = grids.shape[1:]
    left, across = _between(places[:, 0], columns)
    top, down = _between(places[:, 1], rows)
    dark, brighter = _between(guide, levels)
    vertices, weights = [], []
    for x, y, z in product((0, 1), repeat=3):
        vertices.append(((images * levels + dark + z) * rows + top + y) * columns + left + x)
        weights.append((across if x else 1 - across) * (down if y else 1 - down) * (brighter if z else 1 - brighter))
    # Not `grids[...]`: its gradient depends on the order of the threads' sums.
    corners = functional.embedding(torch.stack(vertices, 1), grids.reshape(-1, channels))
    return (torch.stack(weights, 1)[..., None] * corners).sum(1)


def sliced_image(grid: Tensor, guide: Tensor) -> Tensor:
    """Return `sliced` for all pixels of an image, at their centres, by products of matrices.

    A grid is interpolated along columns and rows for each level of luminance, and then between the levels.

    Args:
        grid: (L, H, W, C) grid of the image.
        guide: (h, w) luminance of its pixels.

    Returns:
        (h, w, C) values.
    """
    levels, rows, columns, channels = grid.shape
    height, width = guide.shape
    down, across = _hats(_centers(height, grid), rows), _hats(_centers(width, grid), columns)
    tall = (down @ grid.flatten(2)).view(levels, height, columns, channels)
    whole = across @ tall  # (L, h, w, C)
    return (_hats(guide, levels).movedim(-1, 0)[..., None] * whole).sum(0)


def variation(grids: Tensor) -> Tensor:
    """Return the total variation () of grids: mean squares of differences of neighbours, added over the three axes.

    Args:
        grids: (M, L, H, W, C) grids.
    """
    return torch.stack([grids.diff(dim=axis).square().mean() for axis in (1, 2, 3)]).sum()


def _between(positions: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the vertex (N,) int64 before each position in [0, 1], and the share (N,) of the way to the next one."""
    along = positions.clamp(0, 1) * (count - 1)
    before = along.detach().nan_to_num(0.0).floor().clamp(max=count - 2)  # the share stays NaN
    return before.long(), along - before


def _centers(count: int, like: Tensor) -> Tensor:
    """Return the positions (count,) of the centres of pixels along an edge, from 0 to 1."""
    return (torch.arange(count, dtype=like.dtype, device=like.device) + 0.5) / count


def _hats(positions: Tensor, count: int) -> Tensor:
    """Return the weights (..., count) of all vertices at positions (...) in [0, 1]; at most two of them are not 0."""
    vertices = torch.arange(count, dtype=positions.dtype, device=positions.device)
    return (1 - (positions.clamp(0, 1)[..., None] * (count - 1) - vertices).abs()).clamp(min=0)
