"""Conditions for all values that a reader takes: they can be computed with."""

import math

import torch
from torch import Tensor

from nerfloom import Cameras, Dataset, ParsedScene
from tests.fuzz.reader import require

DIRECTION_TOLERANCE = 1e-2
"""How far from 1 the length of a ray's direction may be: poses are rigid to a thousandth."""


def check_scene(scene: ParsedScene) -> None:
    """Raises: Nonsense where cameras, box or placement are none."""
    cameras, count = scene.cameras, len(scene.image_paths)
    require(len(cameras) == count >= 1, f"{count} images and {len(cameras)} cameras")
    check_cameras(cameras, scene.near, scene.far)
    require(0 <= scene.near < scene.far < math.inf, f"near {scene.near}, far {scene.far}")
    _finite("the box", scene.box)
    require(bool((scene.box[0] < scene.box[1]).all()), f"the box {scene.box.tolist()}")
    require(0 < scene.scale < math.inf, f"the scale {scene.scale}")
    for name in ("transform", "times", "points"):
        if getattr(scene, name) is not None:
            _finite(name, getattr(scene, name))
    if scene.times is not None:
        require(bool(((scene.times >= 0) & (scene.times <= 1)).all()), f"times {scene.times.tolist()}")


def check_cameras(cameras: Cameras, near: float, far: float) -> None:
    """Raises: Nonsense where cameras have no rays."""
    _finite("the poses", cameras.camera_to_worlds)
    for name in ("fx", "fy", "cx", "cy"):
        _finite(name, getattr(cameras, name))
    require(bool((cameras.fx > 0).all()) and bool((cameras.fy > 0).all()), "a focal length that is not positive")
    require(bool((cameras.widths > 0).all()) and bool((cameras.heights > 0).all()), "images without pixels")
    _check_rays(cameras, near, far)


def _check_rays(cameras: Cameras, near: float, far: float) -> None:
    """Check the rays through the corners of every image."""
    count = len(cameras)
    indices = torch.arange(count).repeat(4)
    columns = torch.cat([0 * cameras.widths, cameras.widths - 1] * 2).float()
    rows = torch.cat([0 * cameras.heights] * 2 + [cameras.heights - 1] * 2).float()
    rays = cameras.rays(indices, columns, rows, near, far)
    _finite("origins of rays", rays.origins)
    _finite("directions of rays", rays.directions)
    off = (rays.directions.norm(dim=-1) - 1).abs().max().item()
    require(off <= DIRECTION_TOLERANCE, f"directions of rays with a length that is off by {off:.2g}")
    if rays.pixel_radii is not None:
        _finite("radii of pixels", rays.pixel_radii)


def check_dataset(data: Dataset) -> None:
    """Raises: Nonsense where pixels and cameras do not fit each other."""
    sizes = list(zip(data.cameras.heights.tolist(), data.cameras.widths.tolist(), strict=True))
    require(len(data.names) == len(data) == len(sizes) >= 1, f"{len(data.names)} names of {len(data)} images")
    require(len(data.pixels) == sum(height * width for height, width in sizes), f"{len(data.pixels)} pixels of {sizes}")
    for index, size in enumerate(sizes):
        require(tuple(data.image(index).shape[:2]) == size, f"image {index} has not the size {size}")
    for name in ("kept", "drawn", "opaque"):
        chosen = getattr(data, name)
        if chosen is not None:
            every = chosen.pixels()
            require(len(every) == len(chosen), f"{name} counts {len(chosen)} pixels, and lists {len(every)}")
            inside = bool(((every >= 0) & (every < len(data.pixels))).all())
            require(inside, f"{name} holds pixels that are not there")
    require(data.drawn is None or len(data.drawn) > 0, "there is no pixel to draw")
    if data.depths is not None:
        require(len(data.depths) == len(data.pixels), "depths of other pixels")
        _finite("the depths", data.depths)
        require(bool((data.depths >= 0).all()), "depths below zero")


def _finite(what: str, values: Tensor) -> None:
    require(bool(torch.isfinite(values).all()), f"{what} are not finite")
