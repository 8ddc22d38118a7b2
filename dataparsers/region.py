"""The region shown in renders: a cube, from silhouettes of matter, otherwise from where cameras look."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from nerfloom import Cameras, DataError
from nerfloom.base.evenly_spaced import evenly_spaced
from nerfloom.cameras.poses import MIN_SHARE_LOOKING, NEAR, Placement, looked_at, place
from nerfloom.data.image_files import may_be_transparent, read_image
from nerfloom.scene.enclosing_box import enclosing_box, is_larger

HALF_SIZE = 1.5
"""Half the side of a scene's box, scene units: NeRF-Synthetic's, which methods' settings were tuned on."""
SHOWN = 1.034
"""Half the side of NeRF-Synthetic's box, relative to half the width of the plane through the origin in its images."""
MAX_IMAGES = 32
"""Maximum number of images for silhouettes."""
SLACK = 0.8
"""Rays start at this fraction of the smallest distance between a camera and the matter. They end at the largest such
distance divided by it. Cameras of other splits may be nearer or farther."""
FAR = 1000.0
"""Far distance of an unbounded scene, scene units."""

LOOKED_AT = "where the cameras look"
"""Description of a region not based on silhouettes."""


@dataclass(frozen=True)
class Region:
    """A cube of the input's space. All lengths are in the input's units."""

    center: Tensor
    """(3,) float64 centre of the cube."""
    half: float
    """Half the side of the cube."""
    near: float
    """Distance from a camera where the scene starts."""
    far: float
    """Distance from a camera where the scene ends."""
    unbounded: bool
    """Whether there may be visible content outside the cube."""
    reason: str
    """Description of the cube, as a clause for a message."""

    @property
    def placement(self) -> Placement:
        """The placement that maps the cube to the box of NeRF-Synthetic."""
        transform = torch.cat([torch.eye(3, dtype=torch.float64), -self.center[:, None]], -1)
        return Placement(transform, HALF_SIZE / self.half)

    @property
    def description(self) -> str:
        """Size, position and reason in words."""
        center = ", ".join(f"{value:.4g}" for value in self.center.tolist())
        return f"in a cube of side {2 * self.half:.4g} around ({center}), {self.reason}"


def find_region(
    cameras: Cameras, images: Sequence[Path], moving: bool, cube: tuple[Tensor, float] | None = None
) -> Region:
    """Return the region shown in renders.

    In a static scene, the region is the cube around the box that the silhouettes leave for matter (`enclosing_box`), if
    they determine one. Otherwise it is centred at the point that the cameras look at, with the size that images show
    there. If they look at no common point, it is the cube stated in the file, or one around the cameras. Without alpha,
    or if matter is larger than the images, there may be content outside.

    Args:
        cameras: M cameras in the input's frame.
        images: M files.
        moving: whether images show different times.
        cube: centre (3,) float64 and edge of instant-ngp's cube; None if the file has none.
    """
    few = evenly_spaced(len(images), MAX_IMAGES)
    opaque = _opaque([images[index] for index in few.tolist()])
    seen = _where_cameras_look(cameras, every=opaque is not None)
    ends, box, reason = False, None, LOOKED_AT
    if opaque is not None:
        ends = seen is not None and (moving or not is_larger(opaque))
        central = cameras.model not in ("orthographic", "equirectangular")
        if central and not moving:  # silhouettes of different times cannot be combined
            box = enclosing_box(cameras[few], opaque)
            if box is None and seen is not None and ends:
                box = enclosing_box(cameras[few], opaque, _cube(*seen))
    if box is not None:
        center, half = box.mean(0), float((box[1] - box[0]).max()) / 2
        ends, reason = True, f"from the silhouettes of {len(few)} images"
    elif seen is not None:
        center, half = seen
    elif cube is not None:
        center, half, reason = cube[0], cube[1] / 2, "from the file's aabb_scale"
    else:
        around = place(cameras.camera_to_worlds, "none", "poses")
        center, half, reason = -around.transform[:, 3].double(), 1 / around.scale, "around the cameras"
    near, far = NEAR * half / HALF_SIZE, FAR * half / HALF_SIZE
    if ends:
        near, far = distances(cameras, _cube(center, half) if box is None else box)
    return Region(center, half, near, far, not ends, reason)


def _cube(center: Tensor, half: float) -> Tensor:
    return torch.stack([center - half, center + half])


def cube_at_origin(cameras: Cameras, half: float) -> Region:
    """Return a cube of half side `half` around the origin, with near and far for `cameras`."""
    center = torch.zeros(3, dtype=torch.float64)
    return Region(center, half, *distances(cameras, _cube(center, half)), False, "from --half-size")


def _opaque(images: Sequence[Path]) -> list[Tensor] | None:
    """Return the pixels (H, W) bool of images that are not fully transparent; None if no image has transparent pixels.

    All pixels of an unreadable image count as opaque, which adds no constraint; it is reported when it is decoded.
    """
    if not any(may_be_transparent(path) for path in images):
        return None
    with ThreadPoolExecutor(min(len(images), os.cpu_count() or 1)) as pool:
        opaque = list(pool.map(_opaque_pixels, images))
    return None if all(bool(mask.all()) for mask in opaque) else opaque


def _opaque_pixels(path: Path) -> Tensor:
    try:
        return torch.from_numpy(read_image(path)[..., 3] > 0)
    except DataError:
        return torch.ones(1, 1, dtype=torch.bool)


def distances(cameras: Cameras, box: Tensor) -> tuple[float, float]:
    """Return near and far, from the smallest and the largest distance between cameras and points of a box.

    Near is at least a small fraction of the box that cameras inside it hardly resolve.

    Args:
        cameras: M cameras.
        box: (2, 3) float64 minimum and maximum corner.
    """
    origins = cameras.camera_to_worlds[:, :, 3].double()
    nearest = (origins - torch.minimum(torch.maximum(origins, box[0]), box[1])).norm(dim=-1)
    furthest = torch.maximum((origins - box[0]).abs(), (origins - box[1]).abs()).norm(dim=-1)
    least = NEAR * float((box[1] - box[0]).max()) / (2 * HALF_SIZE)
    return max(SLACK * float(nearest.min()), least), float(furthest.max()) / SLACK


def _where_cameras_look(cameras: Cameras, every: bool) -> tuple[Tensor, float] | None:
    """Return the point (3,) float64 nearest to the optical axes, if most images show it, and the size they show there.

    Args:
        cameras: M cameras.
        every: True for the largest size in any image, False for the median size.

    Returns:
        Point and half the side of a cube; None if fewer than `MIN_SHARE_LOOKING` of the images show a common point.
    """
    point = None if cameras.model == "equirectangular" else looked_at(cameras.camera_to_worlds)
    if point is None:
        return None
    where = torch.arange(len(cameras))
    columns, rows, ahead = cameras.project(point.to(cameras.fx).expand(len(cameras), 3), where)
    inside = (columns > -0.5) & (columns < cameras.widths - 0.5) & (rows > -0.5) & (rows < cameras.heights - 0.5)
    if float((inside & ahead).double().mean()) < MIN_SHARE_LOOKING:
        return None
    across = torch.maximum(cameras.cx, cameras.widths - cameras.cx) / cameras.fx
    down = torch.maximum(cameras.cy, cameras.heights - cameras.cy) / cameras.fy
    shown = torch.maximum(across, down).double()
    if cameras.model != "orthographic":  # orthographic images show the same size at all distances
        shown = shown * (cameras.camera_to_worlds[:, :, 3].double() - point).norm(dim=-1)
    return point, SHOWN * float(shown.max() if every else shown.median())
