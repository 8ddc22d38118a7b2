"""Colours of blocks that learned in different light, exposure or white balance, matched by affine functions.

Block-NeRF (Tancik et al. 2022), section 4.3, matches a block to its neighbour by a search for its appearance vector.
Here each block has a matrix of 3 x 4, fitted in closed form to pictures of the images that two blocks share. So it
works with every method, and with exposure and white balance exactly; it cannot move the sun.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import replace
from heapq import heappop, heappush
from itertools import permutations

import torch
from torch import Tensor

from nerfloom.blocks.block import IDENTITY, Affine
from nerfloom.kernels.splats.project import DC
from nerfloom.rendering.light import transformed, without_background
from nerfloom.rendering.rendered import Picture
from nerfloom.splats.gaussians import Gaussians

RIDGE = 1e-3
"""Weight of the squared distance from the identity, beside the mean squared error of colours in [0, 1]."""


def fitted_color(seen: Tensor, wanted: Tensor, ridge: float = RIDGE) -> Tensor:
    """Return the affine function (3, 4) float64 from the colours of one picture to the colours of another.

    It minimises the mean of |M x - y|^2, plus `ridge` times |M - I|^2.

    Args:
        seen: (N, 4) colour of the surface times opacity, and opacity, of N pixels.
        wanted: (N, 3) colour of the surface times opacity, as they should be.
        ridge: weight of the distance from the identity.
    """
    x, y = seen.double(), wanted.double()
    identity = torch.tensor(IDENTITY, dtype=torch.float64, device=x.device)
    moments = x.T @ x / max(len(x), 1) + ridge * torch.eye(4).to(x)
    products = y.T @ x / max(len(x), 1) + ridge * identity
    return torch.linalg.solve(moments, products.T).T


def recolored(picture: Picture, color: Affine, background: Tensor) -> Picture:
    """Return a `picture` in the colours of a function `color`. Its `background` (3,) keeps its own."""
    matrix = torch.tensor(color, dtype=picture.rgb.dtype, device=picture.rgb.device)
    seen = without_background(picture.rgb, picture.accumulation, background)
    return replace(picture, rgb=picture.rgb + transformed(seen, matrix) - seen[..., :3])


def recolored_gaussians(gaussians: Gaussians, color: Affine) -> Gaussians:
    """Return N `gaussians` in the colours of a function `color`.

    Their harmonics are linear in colour, so this is exact before clamping.
    """
    matrix = torch.tensor(color, dtype=torch.float64, device=gaussians.means.device)
    turned, shift = matrix[:, :3], matrix[:, 3]
    plain = (0.5 + DC * gaussians.colors.double()) @ turned.T + shift
    return replace(
        gaussians,
        colors=((plain - 0.5) / DC).to(gaussians.colors),
        harmonics=torch.einsum("ij,njk->nik", turned, gaussians.harmonics.double()).to(gaussians.harmonics),
    )


def matching_order(cameras: Sequence[Sequence[int]]) -> list[tuple[int, int]]:
    """Return the order of matching: pairs of a block and an earlier one that it takes its colours from.

    The first block is the one that shares most images with others; each next pair shares the most images that any pair
    can (Prim's algorithm for a largest spanning tree). A block that shares none with those before starts anew, and is
    in no pair. `cameras` has the indices of the images of each block.
    """
    shared = _shared_images(cameras)
    pairs, done = list[tuple[int, int]](), set[int]()
    for first in sorted(range(len(cameras)), key=lambda number: (-shared[number].total(), number)):
        waiting = [(0, first, first)]  # a heap: the negative number of shared images, a block, and one that is done
        while waiting:
            _, block, reference = heappop(waiting)
            if block in done:
                continue
            done.add(block)
            if block != reference:
                pairs.append((block, reference))
            for other, count in shared[block].items():
                heappush(waiting, (-count, other, block))
    return pairs


def _shared_images(cameras: Sequence[Sequence[int]]) -> list[Counter[int]]:
    """Return, for each block, the other blocks that share images with it, and the number of these images."""
    owners = defaultdict[int, list[int]](list)
    for number, images in enumerate(cameras):
        for image in set(images):
            owners[image].append(number)
    shared = [Counter[int]() for _ in cameras]
    for blocks in owners.values():  # few blocks share an image, however many there are
        for one, other in permutations(blocks, 2):
            shared[one][other] += 1
    return shared
