"""Transient objects: parts of photographs that the photographs around them contradict, found before training.

A plane sweep (Collins 1996) compares a reduced photograph with its neighbours at many distances. What stands still has
its colours in some neighbours at its true distance, also if others see something in front of it (Kang, Szeliski and
Chai 2001). What stands in one photograph alone has them at no distance.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from nerfloom.base.evenly_spaced import evenly_spread
from nerfloom.cameras.ndc import NdcCameras
from nerfloom.cameras.poses import looked_at
from nerfloom.cameras.view import every
from nerfloom.data.dataset import Dataset

SIDE = 64
"""Maximum longer side of reduced photographs, pixels. Poses are accurate to a fraction of such a pixel."""
MAX_TESTED, NEIGHBOURS, DISTANCES = 12, 6, 32
"""Maximum number of tested photographs, neighbours of each, and distances of the sweep, evenly spaced in disparity."""
AGREEING = 2
"""Number of neighbours that must show a colour at the same distance; a single one may by chance."""
NEAREST = 0.3
"""Nearest distance of the sweep, as a fraction of the distance of the point that all cameras look at."""
MIN_BASELINE, MAX_BASELINE, MAX_TURN = 0.05, 0.5, math.radians(30)
"""Minimum and maximum distance of a neighbour, as the same fraction, and maximum angle between viewing directions.
Photographs taken at the same place and moment show the same people. In photographs far apart, surfaces are hidden or
look different, which seems a contradiction."""
MAX_DIFFERENCE = 0.1
"""Maximum difference of colours that agree, a mean over 3 x 3 pixels and three channels."""
MIN_JUDGED = 0.5
"""Minimum fraction of the distances of a pixel that enough neighbours show, and of the pixels of a photograph where
this holds. Other pixels and photographs are not judged."""
MIN_PHOTOGRAPHS = 9
"""Minimum number of judged photographs. Where fewer have near neighbours, the others seem to be contradicted too."""
_DARK = 0.02
"""Added to colours before ratios are computed, so that noise in the dark has little influence."""


@torch.no_grad()
def transient_share(dataset: Dataset) -> float | None:
    """Return the fraction of a photograph that others contradict, the median over up to `MAX_TESTED` photographs.

    The median is 0 in captures where nothing moves, although poses and reflections contradict some of their images.

    Args:
        dataset: images of one scene.

    Returns:
        A fraction in [0, 1]; None if too few photographs show the same places from different positions.
    """
    target = None if isinstance(dataset.cameras, NdcCameras) else looked_at(dataset.cameras.camera_to_worlds)
    if target is None:
        return None
    away = float((dataset.cameras.camera_to_worlds[:, :, 3] - target.to(dataset.device)).norm(dim=-1).median())
    photographs: dict[int, Tensor] = {}
    shares = list[float]()
    for index in evenly_spread(len(dataset), MAX_TESTED):
        around = neighbours(dataset, index, away)
        if len(around) < NEIGHBOURS:
            continue
        photographs |= {each: reduced(dataset, each) for each in (index, *around) if each not in photographs}
        differences = least_differences(dataset, index, around, photographs, NEAREST * away)
        judged = differences.isfinite()
        if judged.float().mean() > MIN_JUDGED:
            contradicted = in_blocks(differences.nan_to_num(0) > MAX_DIFFERENCE)
            shares.append(float(contradicted.sum() / judged.sum()))
    return sorted(shares)[len(shares) // 2] if len(shares) >= MIN_PHOTOGRAPHS else None


def neighbours(dataset: Dataset, index: int, away: float) -> list[int]:
    """Return up to `NEIGHBOURS` images that look like image `index`, from other positions, the nearest first.

    Args:
        away: distance of the cameras from what they show, scene units.
    """
    poses = dataset.cameras.camera_to_worlds
    apart = (poses[:, :, 3] - poses[index, :, 3]).norm(dim=-1) / away
    turns = torch.acos((poses[:, :, 2] @ poses[index, :, 2]).clamp(-1, 1))
    usable = ((apart >= MIN_BASELINE) & (apart <= MAX_BASELINE) & (turns <= MAX_TURN)).nonzero().squeeze(-1)
    return [int(each) for each in usable[(apart + turns)[usable].argsort()[:NEIGHBOURS]]]


def reduced(dataset: Dataset, index: int) -> Tensor:
    """Return image `index` with at most `SIDE` pixels a side, (4, h, w): colours, and the share of kept pixels."""
    height, width = dataset.cameras.sizes[index]
    stride = max(max(height, width) // (4 * SIDE), 1)
    colors = every(dataset.image(index)[..., :3], stride).float() / 255
    kept = dataset.kept_of(index)
    opaque = torch.ones_like(colors[..., :1]) if kept is None else every(kept[..., None], stride).to(colors)
    scale = min(SIDE / max(height, width), 1)
    size = max(round(height * scale), 1), max(round(width * scale), 1)
    return F.interpolate(torch.cat([colors, opaque], -1).permute(2, 0, 1)[None], size, mode="area")[0]


def least_differences(
    dataset: Dataset, index: int, around: list[int], photographs: dict[int, Tensor], near: float
) -> Tensor:
    """Return the difference (h, w) of each pixel of a reduced image from its neighbours, at the best distance.

    At each distance it is the difference from the neighbour that fits second best. Colours of each neighbour are
    multiplied by a factor for each channel, so that exposure and white balance may differ.

    Args:
        dataset: the images.
        index: the image.
        around: its neighbours.
        photographs: `reduced` images by index.
        near: nearest distance, scene units.

    Returns:
        Differences; NaN where too few neighbours show a pixel at most of the distances.
    """
    cameras, image = dataset.cameras, photographs[index]
    (height, width), (_, h, w) = cameras.sizes[index], image.shape
    rows = (torch.arange(h, device=image.device) + 0.5) * (height / h) - 0.5
    columns = (torch.arange(w, device=image.device) + 0.5) * (width / w) - 0.5
    rows, columns = (grid.reshape(-1) for grid in torch.meshgrid(rows, columns, indexing="ij"))
    rays = cameras.rays(torch.full_like(rows, index, dtype=torch.int64), columns, rows, 0.0, 1.0)
    near = max(near, dataset.scene.near)
    far = max(dataset.scene.far, 2 * near)
    distances = 1 / torch.linspace(1 / far, 1 / near, DISTANCES, device=image.device)
    points = (rays.origins + distances[:, None, None] * rays.directions).view(-1, 3)
    differences = []
    for other in around:
        u, v, ahead = cameras.project(points, other)
        places = torch.stack([(u + 0.5) / cameras.sizes[other][1], (v + 0.5) / cameras.sizes[other][0]], -1) * 2 - 1
        inside = ahead & (places.abs() < 1).all(-1)
        places = places.view(1, DISTANCES, h * w, 2)
        sampled = F.grid_sample(photographs[other][None], places, padding_mode="border", align_corners=False)[0]
        sampled = sampled.view(4, DISTANCES, h, w)
        seen = inside.view(DISTANCES, h, w) & (sampled[3] > 0.99)
        differences.append(_matched(image[:3], sampled[:3], seen))
    second = torch.stack(differences).kthvalue(AGREEING, dim=0).values
    shown = second.isfinite().float().mean(0) > MIN_JUDGED
    return torch.where(shown & (image[3] > 0.99), second.amin(0), torch.nan)


def _matched(image: Tensor, sampled: Tensor, seen: Tensor) -> Tensor:
    """Return the differences (D, h, w) of `image` (3, h, w) from one neighbour's colours; infinite where not `seen`.

    `sampled` are the neighbour's colours (3, D, h, w) at D distances. The factors between their lights are medians over
    the half of the pixels that fit best, which depend on the factors: they start from the medians of both photographs.
    """
    gains = (image + _DARK).flatten(1).median(1).values / (sampled + _DARK).flatten(1).median(1).values
    for _ in range(2):
        least, best = _differences(image, sampled, seen, gains).min(0)
        fits = least <= least.median()
        chosen = sampled.gather(1, best.expand(3, 1, *best.shape)).squeeze(1)
        if bool((fits & least.isfinite()).any()):
            gains = ((image + _DARK) / (chosen + _DARK))[:, fits & least.isfinite()].median(1).values
    return _differences(image, sampled, seen, gains)


def _differences(image: Tensor, sampled: Tensor, seen: Tensor, gains: Tensor) -> Tensor:
    """Return mean differences (D, h, w) over 3 x 3 pixels, with `sampled` colours times `gains` (3,)."""
    apart = torch.where(seen, (sampled * gains[:, None, None, None] - image[:, None]).abs().mean(0), 2.0)
    means = F.avg_pool2d(apart[:, None], 3, 1, 1, count_include_pad=False).squeeze(1)
    return torch.where(seen, means, torch.inf)


def in_blocks(mask: Tensor) -> Tensor:
    """Return which pixels of `mask` (h, w) bool are in 3 x 3 pixels of it: edges are thinner, people are not."""
    eroded = F.max_pool2d(1 - F.pad(mask.float(), (1, 1, 1, 1))[None, None], 3, 1) < 0.5
    return F.max_pool2d(eroded.float(), 3, 1, 1)[0, 0] > 0.5
