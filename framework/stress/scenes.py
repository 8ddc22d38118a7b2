"""Plain scenes of the stress tests: a ball rendered in memory, or a few reduced images of a data set.

The ball is at the origin, and its colour is 0.5 + 0.5 n for the normal n, outside and inside. Its images are known in
closed form.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.evenly_spaced import strided
from nerfloom.base.splits import Split
from nerfloom.cameras.cameras import Cameras, subpixels
from nerfloom.data.dataset import Dataset, load_dataset
from nerfloom.data.image_files import reduce_image
from nerfloom.data.parsed_scene import DataParser
from nerfloom.data.pixels.pixel_set import PixelSet
from nerfloom.data.scene import Scene
from nerfloom.testing.ball import RADIUS, cameras_at, trace

HALF_SIZE = 1.5
"""Half the edge of the ball's box, scene units. Every ray within FIELD_OF_VIEW meets the box."""
FIELD_OF_VIEW, SIZE = 30.0, 24
"""Angle of view of the ball's images, degrees, and their width and height, pixels."""
BALL_SHARE = 0.7
"""Diameter of the ball in an image from outside, as a fraction of the image's width."""
NUM_TRAIN, NUM_TEST = 12, 4
"""Number of training and of test images."""
LONGER_SIDE = 48
"""Minimum longer side of a data set's reduced images, pixels; the reduction factor is an integer."""
MIN_NEAR = 0.02
"""Minimum near distance, scene units, for cameras inside the box."""
RAYS_PER_PIXEL = 16
"""Rays per pixel of the ball's images; pixels are means over their area."""


@dataclass(frozen=True)
class Views:
    """Training and test images of a scene."""

    train: Dataset
    """Training images."""
    test: Dataset
    """Test images."""

    def each(self, change: Callable[[Dataset], Dataset]) -> Views:
        """Return the result of `change` on both sets."""
        return Views(change(self.train), change(self.test))

    def to(self, device: torch.device | str) -> Views:
        """Return the images on `device`."""
        return self.each(lambda dataset: dataset.to(device))


# -- the ball -----------------------------------------------------------------------------------------------------


def ball_views(field_of_view: float = FIELD_OF_VIEW, distance: float | None = None) -> Views:
    """Return images of the ball from all sides, with a given box, as from a format that does not place cameras.

    Args:
        field_of_view: angle of view of the images, degrees.
        distance: distance of the cameras from the ball's centre, which they look at; less than RADIUS is inside. If
            None, the distance where the ball takes BALL_SHARE of the images' width.
    """
    radius = distance_for(field_of_view) if distance is None else distance
    train, test = (radius * directions(count, turn) for count, turn in ((NUM_TRAIN, 0.0), (NUM_TEST, 1.0)))
    return Views(ball_dataset(train, field_of_view), ball_dataset(test, field_of_view))


def distance_for(field_of_view: float) -> float:
    """Return the distance where the ball takes BALL_SHARE of an image's width; `field_of_view` is in degrees."""
    return RADIUS / math.sin(math.atan(BALL_SHARE * math.tan(math.radians(field_of_view) / 2)))


def directions(count: int, turn: float = 0.0) -> Tensor:
    """Return `count` unit vectors (count, 3) float64 on a Fibonacci lattice, rotated about z by `turn` radians."""
    index = torch.arange(count, dtype=torch.float64) + 0.5
    height = 1 - 2 * index / count
    angle = turn + index * math.pi * (3 - 5**0.5)
    across = (1 - height.square()).sqrt()
    return torch.stack([across * angle.cos(), across * angle.sin(), height], dim=-1)


def ball_dataset(positions: Tensor, field_of_view: float) -> Dataset:
    """Return images of the ball from `positions` (M, 3) float64 at one distance, of `field_of_view` degrees."""
    cameras = cameras_at(positions, field_of_view, SIZE)
    pixels = as_decoded(photograph(cameras))
    distance, reach = float(positions.norm(dim=-1).max()), HALF_SIZE * 3**0.5
    scene = Scene(
        box=torch.tensor([[-HALF_SIZE] * 3, [HALF_SIZE] * 3]),
        near=max(distance - reach, MIN_NEAR),
        far=distance + reach,
        num_cameras=len(cameras),
        has_alpha=pixels.shape[1] == 4,
        moving=False,
        image_size=SIZE,
        camera_to_worlds=cameras.camera_to_worlds,
    )
    paths = tuple(Path(f"ball_{index:02d}.png") for index in range(len(cameras)))
    return Dataset(pixels, cameras, None, paths, scene, torch.eye(4)[:3], 1.0)


def photograph(cameras: Cameras) -> Tensor:
    """Render the ball with `cameras`: RGB with straight alpha (P, 4) uint8, image after image, means over pixels."""
    flat = torch.arange(int(cameras.offsets[-1]))
    rays = cameras.pixel_rays(flat, 0.0, 1.0, subpixels=subpixels(RAYS_PER_PIXEL))
    normals, hits = trace(rays.origins.double(), rays.directions.double())
    weights = hits.double().view(-1, RAYS_PER_PIXEL, 1)
    sums = ((0.5 + 0.5 * normals).view(-1, RAYS_PER_PIXEL, 3) * weights).sum(1)
    rgba = torch.cat([sums / weights.sum(1).clamp(min=1), weights.mean(1)], dim=-1)
    return (rgba * 255).round().to(torch.uint8)


# -- data sets ----------------------------------------------------------------------------------------------------


def data_views(parser: DataParser, data: Path | None) -> Views:
    """Return a few images of `data`, or the embedded scene, by `parser`, evenly spaced in each split and reduced.

    Raises:
        DataError: if a split cannot be read.
    """
    return Views(_few(parser, data, "train", NUM_TRAIN), _few(parser, data, "test", NUM_TEST))


def _few(parser: DataParser, data: Path | None, split: Split, count: int) -> Dataset:
    parsed = parser.parse(data, split)
    few = parsed[torch.tensor(strided(len(parsed.image_paths), count))]
    return reduced(load_dataset(replace(few, num_scales=1), split), LONGER_SIDE)


def reduced(dataset: Dataset, side: int) -> Dataset:
    """Return images of a `dataset` reduced by the largest integer factor with a longest side of `side` pixels or more.

    A reduced pixel counts if masks keep all of its pixels. Depth images are omitted.
    """
    factor = max(dataset.scene.image_size // side, 1)

    def blocks(mask: Tensor) -> Tensor:
        height, width = (n // factor for n in mask.shape)
        return mask[: height * factor, : width * factor].view(height, factor, width, factor).all(3).all(1)

    images = range(len(dataset))
    pixels = torch.cat([_box_filtered(dataset.image(index), factor) for index in images])
    return with_photographs(dataset, pixels, dataset.cameras.scaled(1 / factor), kept_of(dataset, images, blocks))


def _box_filtered(image: Tensor, factor: int) -> Tensor:
    """Return an image (H, W, 3 or 4) reduced by an integer factor, as (H' W', 4)."""
    rgba = torch.full((*image.shape[:2], 4), 255, dtype=torch.uint8)
    rgba[..., : image.shape[-1]] = image
    return torch.from_numpy(np.ascontiguousarray(reduce_image(rgba.numpy(), factor))).view(-1, 4)


# -- replacement of images ----------------------------------------------------------------------------------------


def as_decoded(pixels: Tensor) -> Tensor:
    """Return `pixels` (P, 3 or 4) as decoded from files: without alpha if it is 255 everywhere."""
    opaque = pixels.shape[1] == 4 and bool((pixels[:, 3] == 255).all())
    return pixels[:, :3].contiguous() if opaque else pixels


def with_photographs(
    dataset: Dataset, pixels: Tensor, cameras: Cameras | None = None, kept: PixelSet | None = None
) -> Dataset:
    """Return a data set with other images, and its scene's properties changed accordingly.

    Args:
        dataset: the data set.
        pixels: (P, 3 or 4) uint8 pixels of all images.
        cameras: cameras of the images; if None, the cameras of `dataset`.
        kept: pixels that count; None for all.
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
    """Return the pixels of some images that masks keep after a change.

    Args:
        dataset: the images.
        images: indices of the images.
        change: function from a mask (H, W) to the changed one.

    Returns:
        The kept pixels, counted over the given images; None if there are no masks.
    """
    masks = (dataset.kept_of(index) for index in images)
    changed = [change(mask).reshape(-1) for mask in masks if mask is not None]
    return PixelSet.of_mask(torch.cat(changed)) if changed else None
