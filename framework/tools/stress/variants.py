"""Hard variants of a scene: pure functions from photographs with poses to others."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from framework.cameras.poses import place
from framework.data.dataset import Dataset
from framework.tools.stress.scenes import Views, kept_of, with_photographs

# -- what the photographs show ------------------------------------------------------------------------------------


def plain_colored(dataset: Dataset, level: int) -> Dataset:
    """Photographs that are `level` (0 to 255) everywhere in all channels, and opaque."""
    return with_photographs(dataset, torch.full((len(dataset.pixels), 3), level, dtype=torch.uint8))


def transparent(dataset: Dataset) -> Dataset:
    """Photographs of nothing: alpha is 0 everywhere."""
    return with_photographs(dataset, torch.zeros(len(dataset.pixels), 4, dtype=torch.uint8))


def one_pixel(dataset: Dataset) -> Dataset:
    """Each photograph as the one pixel that is its mean; the cameras see what they saw."""
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
    """(C,) uint8 the mean of an image (H, W, C); of four channels the colours count as far as they are opaque."""
    values = image.reshape(-1, image.shape[-1]).double()
    color, alpha = values[:, :3], values[:, 3:]
    if alpha.shape[1] == 0:
        return color.mean(0).round().to(torch.uint8)
    mean = (color * alpha).sum(0) / alpha.sum().clamp(min=1)
    return torch.cat([mean, alpha.mean(0)]).round().to(torch.uint8)


# -- which photographs there are ----------------------------------------------------------------------------------


def chosen(dataset: Dataset, images: list[int]) -> Dataset:
    """Some of the photographs, each as often as it is named."""
    index = torch.tensor(images)
    pixels = torch.cat([dataset.image(image).flatten(0, 1) for image in images])
    changed = with_photographs(dataset, pixels, dataset.cameras[index], kept_of(dataset, images, lambda mask: mask))
    times = None if dataset.times is None else dataset.times[index]
    return replace(changed, times=times, names=tuple(dataset.names[image] for image in images))


def first_image(dataset: Dataset) -> Dataset:
    """The first photograph alone."""
    return chosen(dataset, [0])


def twice(dataset: Dataset) -> Dataset:
    """Every photograph and its camera twice."""
    return chosen(dataset, [*range(len(dataset))] * 2)


# -- where the scene is -------------------------------------------------------------------------------------------


def moved(views: Views, scale: float = 1.0, shift: float = 0.0, placed: bool = False) -> Views:
    """The scene in another unit and elsewhere: each place x becomes scale * x + shift, the same along every axis.

    That can reach a method in two ways, and both are fair:

    - As blender's format delivers it, which takes cameras as they are: box, near and far are the user's (--half-size,
      --near, --far), so they are given in the same unit and about the same middle. The method is told all of it.
    - `placed`, as formats of captures deliver it: the cameras' mean position becomes the origin and their positions
      fit into [-1, 1] (`framework.cameras.poses.place`), in float64, for that is what files of text hold; only then
      are they rounded. The orientation is left as it is, so that the box can follow exactly. What is left of scale and
      shift is rounding.

    All is computed in float64 and rounded once.
    """
    factor, offset = scale, torch.full((3,), shift, dtype=torch.float64)
    if placed:
        poses = torch.cat([dataset.cameras.camera_to_worlds for dataset in (views.train, views.test)]).double()
        poses[:, :, 3] = factor * poses[:, :, 3] + offset
        found = place(poses, orientation="none")
        factor, offset = found.scale * factor, found.scale * (offset + found.transform[:, 3].double())
    return views.each(partial(_mapped, factor=factor, offset=offset))


def _mapped(dataset: Dataset, factor: float, offset: Tensor) -> Dataset:
    """Every place x as factor * x + offset (3,) float64, and what leads from the input's frame to the scene's."""
    poses, scene = dataset.cameras.camera_to_worlds.to(torch.float64, copy=True), dataset.scene
    poses[:, :, 3] = factor * poses[:, :, 3] + offset
    cameras = replace(dataset.cameras, camera_to_worlds=poses.float())
    transform = dataset.transform.to(torch.float64, copy=True)
    transform[:, 3] += offset / (factor * dataset.scale)  # it is applied before the scale
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
        transform=transform.float(),
        scale=factor * dataset.scale,
    )
