"""Hard variants of a scene: pure functions from data sets to data sets."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from nerfloom.cameras.poses import place
from nerfloom.data.dataset import Dataset
from nerfloom.stress.scenes import Views, kept_of, with_photographs

# -- images ---------------------------------------------------------------------------------------------------------


def plain_colored(dataset: Dataset, level: int) -> Dataset:
    """Return `dataset` with opaque images that are `level`, 0 to 255, in all pixels and channels."""
    return with_photographs(dataset, torch.full((len(dataset.pixels), 3), level, dtype=torch.uint8))


def transparent(dataset: Dataset) -> Dataset:
    """Return `dataset` with fully transparent images."""
    return with_photographs(dataset, torch.zeros(len(dataset.pixels), 4, dtype=torch.uint8))


def one_pixel(dataset: Dataset) -> Dataset:
    """Return `dataset` with each image reduced to one pixel, its mean, and cameras with the same angle of view."""
    pixels = torch.stack([mean_color(dataset.image(index)) for index in range(len(dataset))])
    cameras = dataset.cameras
    widths, heights, ones = cameras.widths, cameras.heights, torch.ones_like(cameras.widths)
    cameras = replace(
        cameras,
        fx=cameras.fx / widths,
        fy=cameras.fy / heights,
        cx=cameras.cx / widths,
        cy=cameras.cy / heights,
        widths=ones,
        heights=ones,
    )
    return with_photographs(dataset, pixels, cameras)


def mean_color(image: Tensor) -> Tensor:
    """Return the mean colour (C,) uint8 of an `image` (H, W, C); if C is 4, colours are weighted by alpha."""
    values = image.reshape(-1, image.shape[-1]).double()
    color, alpha = values[:, :3], values[:, 3:]
    if alpha.shape[1] == 0:
        return color.mean(0).round().to(torch.uint8)
    mean = (color * alpha).sum(0) / alpha.sum().clamp(min=1)
    return torch.cat([mean, alpha.mean(0)]).round().to(torch.uint8)


def with_distractors(dataset: Dataset, share: float, seed: int = 0) -> Dataset:
    """Return `dataset` with opaque discs of one colour over a `share` of each image, by `seed`."""
    generator, images = torch.Generator().manual_seed(seed), []
    for index in range(len(dataset)):
        image = dataset.image(index).clone()
        height, width = image.shape[:2]
        rows, columns = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
        covered = torch.zeros(height, width, dtype=torch.bool)
        while covered.float().mean() < share:
            row, column, size, *color = torch.rand(6, generator=generator).tolist()
            radius = (0.1 + 0.15 * size) * min(height, width)
            disc = (rows - row * height).square() + (columns - column * width).square() < radius**2
            image[disc] = torch.tensor([*(round(255 * c) for c in color), 255][: image.shape[-1]], dtype=torch.uint8)
            covered |= disc
        images.append(image.flatten(0, 1))
    return with_photographs(dataset, torch.cat(images), kept=dataset.kept)


# -- selection of images ------------------------------------------------------------------------------------------


def chosen(dataset: Dataset, images: list[int]) -> Dataset:
    """Return `dataset` with the images at the indices `images`, which may repeat."""
    index = torch.tensor(images)
    pixels = torch.cat([dataset.image(image).flatten(0, 1) for image in images])
    changed = with_photographs(dataset, pixels, dataset.cameras[index], kept_of(dataset, images, lambda mask: mask))
    times = None if dataset.times is None else dataset.times[index]
    return replace(changed, times=times, paths=tuple(dataset.paths[image] for image in images), given_names=None)


def first_image(dataset: Dataset) -> Dataset:
    """Return `dataset` with the first image only."""
    return chosen(dataset, [0])


def twice(dataset: Dataset) -> Dataset:
    """Return `dataset` with each image and its camera twice."""
    return chosen(dataset, [*range(len(dataset))] * 2)


# -- units and origin ---------------------------------------------------------------------------------------------


def moved(views: Views, scale: float = 1.0, shift: float = 0.0, placed: bool = False) -> Views:
    """Return a scene with another unit and origin: position x becomes scale * x + shift along each axis.

    Formats place such a scene in one of two ways:

    - Not `placed`: with --half-size, --near and --far the blender format takes cameras unchanged, and these flags are
      in the same unit and around the same centre. So they are transformed like the cameras.
    - `placed`: capture formats move the cameras' mean position to the origin and scale positions to [-1, 1]
      (`nerfloom.cameras.poses.place`), in float64, as in text files, and round afterwards. The orientation is kept, so
      that the box can be transformed exactly. Only rounding errors of scale and shift remain.

    All computations are in float64, rounded once.

    Args:
        views: the images.
        scale: new units per old unit.
        shift: displacement along each axis, new units.
        placed: whether cameras are placed as in captures.
    """
    factor, offset = scale, torch.full((3,), shift, dtype=torch.float64)
    if placed:
        poses = torch.cat([dataset.cameras.camera_to_worlds for dataset in (views.train, views.test)]).double()
        poses[:, :, 3] = factor * poses[:, :, 3] + offset
        placement = place(poses, orientation="none")
        factor, offset = placement.scale * factor, placement.scale * (offset + placement.transform[:, 3])
    return views.each(partial(_mapped, factor=factor, offset=offset))


def _mapped(dataset: Dataset, factor: float, offset: Tensor) -> Dataset:
    """Return `dataset` with each position x at factor * x + offset (3,), and the transform from the input changed."""
    poses, scene = dataset.cameras.camera_to_worlds.to(torch.float64, copy=True), dataset.scene
    poses[:, :, 3] = factor * poses[:, :, 3] + offset
    cameras = replace(dataset.cameras, camera_to_worlds=poses.float())
    transform = dataset.transform.clone()
    transform[:, 3] += offset / (factor * dataset.scale)  # applied before the scale
    return replace(
        dataset,
        cameras=cameras,
        scene=replace(
            scene,
            box=(factor * scene.box.double() + offset).float(),
            near=factor * scene.near,
            far=factor * scene.far,
            camera_to_worlds=cameras.camera_to_worlds,
        ),
        transform=transform,
        scale=factor * dataset.scale,
    )
