"""The scenes that hard conditions start from: a ball made in memory, or a few photographs of somebody's data, reduced.

The ball stands at the origin and is coloured by its normal n: 0.5 + 0.5 n. From within it is a room of the same
colours. So everything that its pictures should show is known in closed form.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from framework.cameras.cameras import Cameras, subpixels
from framework.data.dataset import DataParser, Dataset, Split, load_dataset
from framework.data.image_files import reduce_image
from framework.data.pixel_set import PixelSet
from framework.data.scene import Scene
from framework.evaluation.evaluator import spread
from framework.tools.testing.ball import RADIUS, cameras_at, trace

HALF_SIZE = 1.5
"""Half the edge of the ball's box, scene units. Every ray of FIELD_OF_VIEW or less meets the box."""
FIELD_OF_VIEW, SIZE = 30.0, 24
"""Of the ball's pictures, degrees; and their width and height, pixels."""
SHARE = 0.7
"""Of a picture's width that the ball takes, seen from outside."""
NUM_TRAIN, NUM_TEST = 12, 4
"""Photographs to learn from, and to be judged by."""
LONGER_SIDE = 48
"""Pixels to which photographs of somebody's data are reduced, or a few more: by a whole number."""
NEAREST = 0.02
"""Distance from cameras among the scene at which it may start."""
RAYS_PER_PIXEL = 16
"""Of the ball's pictures: a photograph's pixel is an area."""


@dataclass(frozen=True)
class Views:
    """Photographs of one scene."""

    train: Dataset
    """To learn from."""
    test: Dataset
    """To be judged by."""

    def each(self, change: Callable[[Dataset], Dataset]) -> Views:
        """Both sets changed alike."""
        return Views(change(self.train), change(self.test))

    def to(self, device: torch.device | str) -> Views:
        """The same photographs on `device`."""
        return self.each(lambda dataset: dataset.to(device))


# -- the ball -----------------------------------------------------------------------------------------------------


def ball_views(field_of_view: float = FIELD_OF_VIEW, distance: float | None = None) -> Views:
    """The ball from all sides, as a format delivers it that is not placed: the box is stated, not found.

    Args:
        field_of_view: of the pictures, degrees.
        distance: of the cameras from the ball's centre, at which they look; less than RADIUS is inside. If None, the
            distance from which the ball takes SHARE of a picture's width.
    """
    away = distance_for(field_of_view) if distance is None else distance
    train, test = (away * directions(count, turn) for count, turn in ((NUM_TRAIN, 0.0), (NUM_TEST, 1.0)))
    return Views(ball_dataset(train, field_of_view), ball_dataset(test, field_of_view))


def distance_for(field_of_view: float) -> float:
    """From where the ball takes SHARE of a picture's width; `field_of_view` in degrees."""
    return RADIUS / math.sin(math.atan(SHARE * math.tan(math.radians(field_of_view) / 2)))


def directions(count: int, turn: float = 0.0) -> Tensor:
    """(count, 3) float64 unit vectors, spread evenly (Fibonacci lattice) and turned about z by `turn` radians."""
    index = torch.arange(count, dtype=torch.float64) + 0.5
    height = 1 - 2 * index / count
    angle = turn + index * math.pi * (3 - 5**0.5)
    across = (1 - height.square()).sqrt()
    return torch.stack([across * angle.cos(), across * angle.sin(), height], dim=-1)


def ball_dataset(positions: Tensor, field_of_view: float) -> Dataset:
    """Photographs of the ball from positions (M, 3) float64, all equally far from its centre."""
    cameras = cameras_at(positions, field_of_view, SIZE)
    pixels = as_decoded(photograph(cameras))
    distance, reach = float(positions.norm(dim=-1).max()), HALF_SIZE * 3**0.5
    scene = Scene(
        box=torch.tensor([[-HALF_SIZE] * 3, [HALF_SIZE] * 3]),
        near=max(distance - reach, NEAREST),
        far=distance + reach,
        num_cameras=len(cameras),
        has_alpha=pixels.shape[1] == 4,
        moving=False,
        image_size=SIZE,
        camera_to_worlds=cameras.camera_to_worlds,
    )
    names = tuple(f"ball_{index:02d}.png" for index in range(len(cameras)))
    return Dataset(pixels, cameras, None, names, scene, torch.eye(4)[:3], 1.0)


def photograph(cameras: Cameras) -> Tensor:
    """(P, 4) uint8 what cameras see of the ball, image after image: means over pixels, straight alpha."""
    flat = torch.arange(int(cameras.offsets[-1]))
    rays = cameras.pixel_rays(flat, 0.0, 1.0, subpixels=subpixels(RAYS_PER_PIXEL))
    normals, hits = trace(rays.origins.double(), rays.directions.double())
    weights = hits.double().view(-1, RAYS_PER_PIXEL, 1)
    sums = ((0.5 + 0.5 * normals).view(-1, RAYS_PER_PIXEL, 3) * weights).sum(1)
    rgba = torch.cat([sums / weights.sum(1).clamp(min=1), weights.mean(1)], dim=-1)
    return (rgba * 255).round().to(torch.uint8)


# -- somebody's data ----------------------------------------------------------------------------------------------


def data_views(parser: DataParser, data: Path | None) -> Views:
    """A few photographs of a data set, evenly spread over each split and reduced.

    Raises: DataError where a split cannot be read.
    """
    return Views(_few(parser, data, "train", NUM_TRAIN), _few(parser, data, "test", NUM_TEST))


def _few(parser: DataParser, data: Path | None, split: Split, count: int) -> Dataset:
    parsed = parser.parse(data, split)
    few = parsed[torch.tensor(spread(len(parsed.image_paths), count))]
    return reduced(load_dataset(few, split), LONGER_SIDE)


def reduced(dataset: Dataset, side: int) -> Dataset:
    """Photographs reduced by the largest whole number that leaves the longest side `side` pixels or more.

    A reduced pixel counts where masks leave all of what it is made from. Depth images are left out.
    """
    factor = max(dataset.scene.image_size // side, 1)

    def blocks(mask: Tensor) -> Tensor:
        height, width = (n // factor for n in mask.shape)
        return mask[: height * factor, : width * factor].view(height, factor, width, factor).all(3).all(1)

    images = range(len(dataset))
    pixels = torch.cat([_box_filtered(dataset.image(index), factor) for index in images])
    return with_photographs(dataset, pixels, dataset.cameras.scaled(1 / factor), kept_of(dataset, images, blocks))


def _box_filtered(image: Tensor, factor: int) -> Tensor:
    """An image (H, W, 3 or 4) reduced by a whole number, as (H' W', 4)."""
    rgba = torch.full((*image.shape[:2], 4), 255, dtype=torch.uint8)
    rgba[..., : image.shape[-1]] = image
    return torch.from_numpy(np.ascontiguousarray(reduce_image(rgba.numpy(), factor))).view(-1, 4)


# -- other photographs in a data set ------------------------------------------------------------------------------


def as_decoded(pixels: Tensor) -> Tensor:
    """Pixels (P, 3 or 4) without an alpha that says nothing, for that is how photographs are decoded."""
    opaque = pixels.shape[1] == 4 and bool((pixels[:, 3] == 255).all())
    return pixels[:, :3].contiguous() if opaque else pixels


def with_photographs(
    dataset: Dataset, pixels: Tensor, cameras: Cameras | None = None, kept: PixelSet | None = None
) -> Dataset:
    """The data set with other photographs, what is told of them included.

    Args:
        pixels: (P, 3 or 4) uint8.
        cameras: as many as before; the same if None.
        kept: what counts of the pixels; all if None.
    """
    cameras = dataset.cameras if cameras is None else cameras
    pixels = as_decoded(pixels)
    scene = replace(
        dataset.scene,
        num_cameras=len(cameras),
        has_alpha=pixels.shape[1] == 4,
        image_size=int(torch.maximum(cameras.widths, cameras.heights).max()),
        has_depth=False,
        camera_to_worlds=cameras.camera_to_worlds,
    )
    return replace(
        dataset,
        pixels=pixels,
        cameras=cameras,
        scene=scene,
        drawn=None if kept is None else kept.listed(),
        kept=kept,
        opaque=None,
        light=None,
        depths=None,
        mapped=None,
    )


def kept_of(dataset: Dataset, images: Iterable[int], change: Callable[[Tensor], Tensor]) -> PixelSet | None:
    """What masks leave of some images when each mask (H, W) is changed; None where there are no masks."""
    masks = (dataset.kept_of(index) for index in images)
    changed = [change(mask).reshape(-1) for mask in masks if mask is not None]
    return PixelSet.of_mask(torch.cat(changed)) if changed else None
