"""Initial Gaussians at given points, with sizes from distances between points and colours from the images."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from nerfloom.base.console import say, track
from nerfloom.base.errors import ConfigError
from nerfloom.base.evenly_spaced import evenly_spaced
from nerfloom.cameras.cameras import Cameras
from nerfloom.data.dataset import Dataset
from nerfloom.data.scene import Scene
from nerfloom.geometry.bounds import cell_corners
from nerfloom.kernels.splats.project import DC
from nerfloom.scene.silhouettes import Silhouettes, visual_hull
from nerfloom.splats.gaussians import Gaussians

OPACITY = 0.1
"""Initial opacity."""
SURFACE_OPACITY, SURFACE_SIZE = 0.5, 0.7
"""Initial opacity on a field's surfaces, and standard deviation there, in mean distances to the nearest neighbours."""
HULL_CELLS = 128
"""Cells of the visual hull along an axis."""
MAX_MEASURED = 1_000
"""Maximum number of Gaussians used to find distances from the cameras."""
MIN_WIDE_RATIO = 0.5
"""Minimum ratio of image width to distance (28 degrees) of a lens that does not count as long."""
PLACES = {
    "points": "at the points of a reconstruction",
    "field": "on the surfaces of a field",
    "silhouettes": "in the visual hull",
    "random": "anywhere in the box",
}
"""Descriptions of the kinds of initial points."""
PAIRS = 2**24
"""Number of pairs of a point and a camera, for distances in parts."""
NEIGHBOURS = 3
"""Number of neighbours; their mean distance is a Gaussian's initial size."""


def from_points(points: Tensor, colors: Tensor, degree: int, opacity: float = OPACITY, size: float = 1.0) -> Gaussians:
    """Return round Gaussians at points.

    Args:
        points: (N, 3) scene coordinates.
        colors: (N, 3) in [0, 1].
        degree: highest degree of the harmonics.
        opacity: opacity of each Gaussian.
        size: standard deviation, in mean distances to the nearest neighbours.
    """
    count = len(points)
    distance = (size * neighbour_distance(points)).clamp(min=1e-7)
    turn = points.new_zeros(count, 4)
    turn[:, 0] = 1
    logits = points.new_full((count,), opacity).logit()
    harmonics = points.new_zeros(count, 3, (degree + 1) ** 2 - 1)
    return Gaussians(
        points, distance.log()[:, None].expand(-1, 3).clone(), turn, logits, (colors - 0.5) / DC, harmonics
    )


def on_surfaces(points: Tensor, colors: Tensor, degree: int) -> Gaussians:
    """Return Gaussians of `degree` at `points` (N, 3) on a field's surfaces, which are smaller and more opaque.

    Args:
        colors: (N, 3) in [0, 1].
    """
    return from_points(points, colors, degree, SURFACE_OPACITY, SURFACE_SIZE)


def neighbour_distance(points: Tensor, neighbours: int = NEIGHBOURS, outside: float = 0.0) -> Tensor:
    """Return the approximate mean distance (N,) of each point to its nearest neighbours.

    Candidates are adjacent points on four space-filling curves (Morton order with four offsets), which finds most
    neighbours.

    Args:
        points: (N, 3).
        neighbours: number of nearest neighbours.
        outside: share of the points, at both ends of each axis, that the curves need not resolve, so that a few points
            far away do not make them coarse.
    """
    count = len(points)
    if count < 2:
        return points.new_ones(count)
    ordered, skipped = points.sort(0).values, int(outside * count)
    low, high = ordered[skipped], ordered[count - 1 - skipped]
    unit = (points - low) / (high - low).max().clamp(min=1e-12)
    best = points.new_full((count, neighbours), torch.inf)
    for shift in (0.0, 0.137, 0.291, 0.433):
        order = morton(((unit + shift) / 1.5 * (2**20 - 1)).long().clamp(0, 2**20 - 1)).argsort()
        along = points[order]
        steps = range(1, min(2 * neighbours, count - 1) + 1)
        found = [best[order]]
        for step in steps:
            gap = (along[step:] - along[:-step]).norm(dim=-1)
            infinite = gap.new_full((step,), torch.inf)
            found += [torch.cat([gap, infinite])[:, None], torch.cat([infinite, gap])[:, None]]
        # Several curves may find the same neighbour: equal distances count once.
        near = torch.cat(found, 1).sort(1).values
        near[:, 1:][near[:, 1:] == near[:, :-1]] = torch.inf
        best[order] = near.sort(1).values[:, :neighbours]
    known = best.isfinite()
    return best.masked_fill(~known, 0).sum(1) / known.sum(1).clamp(min=1)


def thinned(points: Tensor, count: int) -> Tensor:
    """Return at most `count` points, evenly spaced along a space-filling curve (Morton order).

    Args:
        points: (N, 3), which may be in the order of a scanner's lines.
        count: maximum number of points.
    """
    if len(points) <= count:
        return points
    low, high = points.min(0).values, points.max(0).values
    unit = (points - low) / (high - low).max().clamp(min=1e-12)
    order = morton((unit * (2**20 - 1)).long().clamp(0, 2**20 - 1)).argsort()
    return points[order[evenly_spaced(len(points), count).to(order.device)]]


def morton(cells: Tensor) -> Tensor:
    """Return the index (N,) int64 of cells along a space-filling curve.

    Args:
        cells: (N, 3) int64, from 0 below 2^20.
    """
    code = torch.zeros_like(cells[:, 0])
    for axis in range(3):
        x = cells[:, axis]
        for shift, mask in ((32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F),
                            (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249)):  # fmt: skip
            x = (x | (x << shift)) & mask
        code |= x << axis
    return code


def seen_colors(points: Tensor, dataset: Dataset, views: int = 2) -> Tensor:
    """Return the mean colour (N, 3) in [0, 1] of each point in the nearest cameras, grey where none sees it.

    Args:
        points: (N, 3) scene coordinates.
        dataset: images; transparent pixels do not count.
        views: number of images per point, among the `4 * views` nearest cameras.
    """
    cameras = dataset.cameras
    total, count = points.new_zeros(len(points), 3), points.new_zeros(len(points))
    nearest, away = _nearest_cameras(points, cameras.camera_to_worlds[:, :, 3], 4 * views)
    for index in track(away.argsort().tolist(), "Looking up colours of points", len(cameras)):
        here = ((nearest == index).any(1) & (count < views)).nonzero()[:, 0]
        columns, rows, shown = cameras.project(points[here], index)
        height, width = int(cameras.heights[index]), int(cameras.widths[index])
        column, row = columns.round().long(), rows.round().long()
        shown &= (column >= 0) & (column < width) & (row >= 0) & (row < height)
        if not bool(shown.any()):
            continue
        pixels = dataset.image(index)[row[shown], column[shown]].float() / 255
        weight = pixels[:, 3] if pixels.shape[1] == 4 else torch.ones_like(pixels[:, 0])
        weight = (weight > 0.5).to(points)
        total[here[shown]] += weight[:, None] * pixels[:, :3]
        count[here[shown]] += weight
    return torch.where(count[:, None] > 0, total / count[:, None].clamp(min=1), 0.5)


def _nearest_cameras(points: Tensor, centers: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the nearest cameras (N, min(count, M)) int32 of points, and each camera's mean distance (M,) from them.

    Args:
        points: (N, 3), taken in parts, because all distances of millions of points exceed the memory.
        centers: (M, 3) positions of the cameras.
        count: number of cameras per point.
    """
    nearest, mean = [], torch.zeros_like(centers[:, 0])
    for some in points.split(max(PAIRS // len(centers), 1)):
        distance = torch.cdist(some, centers)
        nearest.append(distance.topk(min(count, len(centers)), largest=False).indices.int())
        mean += distance.mean(0) * (len(some) / len(points))
    return torch.cat(nearest), mean


def hull_points(hull: Tensor, box: Tensor, resolution: int, count: int) -> Tensor:
    """Return random points (count, 3) in the cells along the surface of a visual hull.

    Args:
        hull: (n^3,) bool, cells that may hold something, at least one.
        box: (2, 3) corners of all cells, scene coordinates.
        resolution: n.
        count: number of points.
    """
    grid = hull.view(1, 1, resolution, resolution, resolution).float()
    inner = -torch.nn.functional.max_pool3d(-torch.nn.functional.pad(grid, [1] * 6), 3, stride=1)
    cells = ((grid > 0) & (inner == 0)).view(-1).nonzero()[:, 0]
    chosen = cells[torch.randint(len(cells), (count,), device=cells.device)]
    at = (cell_corners(chosen, resolution) + torch.rand(count, 3, device=cells.device)) / resolution
    return box[0] + at * (box[1] - box[0])


def scene_size(scene: Scene, means: Tensor | None = None, cameras: Cameras | None = None) -> float:
    """Return the size of a scene, scene units: 1.3 times the median distance of Gaussians from the cameras.

    For cameras around a scene this agrees with 3D Gaussian Splatting: 1.1 times the largest distance of a camera from
    their centre, which is used without Gaussians. For cameras side by side that would be too small. With long lenses
    the size is reduced in proportion to the width of the images.

    Args:
        means: (N, 3) centres of Gaussians, scene units; None if there are none yet.
        cameras: M training cameras, for the width of their images; None for usual lenses.
    """
    if scene.camera_to_worlds is None:
        return float((scene.box[1] - scene.box[0]).norm()) / 2
    centers = scene.camera_to_worlds[:, :, 3]
    if means is not None and len(means):
        some = means[:: -(-len(means) // MAX_MEASURED)]
        width = 1.0 if cameras is None else min(float((cameras.widths / cameras.fx).median()) / MIN_WIDE_RATIO, 1.0)
        return 1.3 * width * float(torch.cdist(some, centers.to(some)).median()) or 1.0
    return 1.1 * float((centers - centers.mean(0)).norm(dim=-1).max()) or 1.0


def first_points(kind: Literal["points", "silhouettes", "random"], dataset: Dataset, count: int) -> Tensor:
    """Return the initial points (N, 3) of Gaussians, scene coordinates.

    Args:
        kind: points: the points of a reconstruction. silhouettes: random ones on the surface of the visual hull of
            images with alpha. random: anywhere in the scene's box.
        count: number of random points, or maximum number of points of a reconstruction.

    Raises:
        ConfigError: if the data has no points, or no pinhole images with alpha.
    """
    scene = dataset.scene
    box = scene.box.to(dataset.device)
    if kind == "points":
        if dataset.points is None:
            raise ConfigError("--start points: the data has no points of a reconstruction; leave out --start")
        points = thinned(dataset.points.to(dataset.device), count)
        if len(points) < len(dataset.points):
            say(f"  {len(points):,} of {len(dataset.points):,} points are taken, evenly (--start-gaussians)")
        return points
    if kind == "silhouettes":
        if not scene.has_alpha or dataset.cameras.model != "pinhole":
            raise ConfigError("--start silhouettes needs pinhole images with alpha; leave out --start")
        hull = visual_hull(Silhouettes.of(dataset), scene.box, HULL_CELLS).to(box.device)
        if bool(hull.any()):
            return hull_points(hull, box, HULL_CELLS, count)
        say("warning: the images' alpha leaves no part of the box; Gaussians start anywhere in it")
    return box[0] + torch.rand(count, 3, device=dataset.device) * (box[1] - box[0])
