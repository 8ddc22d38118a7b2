"""Pictures of Gaussians from the framework's cameras."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.view import every
from nerfloom.data.scene import Scene
from nerfloom.geometry.lenses import DISTORTED, LENSES, Distortion, undistort, unproject
from nerfloom.kernels.splats.blend import CHANNELS
from nerfloom.kernels.splats.project import SplatCamera
from nerfloom.rendering.outputs import NORMALS
from nerfloom.rendering.rendered import Picture
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import OURS, Look
from nerfloom.splats.rasteriser import RASTERISER, Projected, Rasteriser

DRAWN = ("pinhole", "opencv", "fisheye", "equirectangular")
"""Camera models that Gaussians can be drawn with."""
EWA_ANGLE = math.radians(89)
"""Largest angle from the optical axis for elliptical weighted averaging, which shows less than 90 degrees. Images of a
fisheye that show more are drawn by the unscented transform, like panoramas."""
FLIPPED = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
"""Maps a camera's axes (x right, y up, looking along -z) to the axes of splatting (x right, y down, z forward)."""


def smallest_depth(scene: Scene) -> float:
    """Return the minimum depth of the centres of drawn Gaussians, scene units."""
    return max(0.2 * scene.near, 1e-3)


def splat_camera(
    camera: Cameras, near: float, look: Look = OURS, pose: Tensor | None = None, reduced: int = 1
) -> SplatCamera:
    """Return a camera in the form that the rasteriser takes.

    Gaussians are projected by the unscented transform on panoramas and on images of a fisheye beyond `EWA_ANGLE`, where
    EWA would leave out a part of the image. On all other images they are projected by EWA.

    Args:
        camera: one camera.
        near: Gaussians at a smaller depth are not drawn, scene units; by the unscented transform, those at a smaller
            distance.
        pose: (3, 4) camera-to-scene pose to use instead of its own; it may require a gradient.
        reduced: ratio of the camera's image size to the drawn one's.

    Raises:
        ConfigError: for a camera model that is not among `DRAWN`.
    """
    if camera.model not in DRAWN:
        raise ConfigError(
            f"Gaussians cannot be drawn for {camera.model} cameras, only for {', '.join(DRAWN)}; "
            "convert the images to these first, or take a method that casts rays, such as nerfacto"
        )
    pose = camera.camera_to_worlds[0] if pose is None else pose
    rotation = _flipped(pose.dtype, pose.device) @ pose[:, :3].T
    to_camera = torch.cat([rotation, -(rotation @ pose[:, 3])[:, None]], 1)
    fx, fy, cx, cy = (value / reduced for value in camera.intrinsics[0])
    height, width = (side // reduced for side in camera.sizes[0])
    lens, wide = None, camera.model == "equirectangular"
    if camera.model == "fisheye" or (camera.lens is not None and LENSES[camera.model]):
        given = (0.0,) * len(LENSES[camera.model]) if camera.lens is None else tuple(camera.lens[0].tolist())
        lens = _lens(camera.model, given)
        wide = camera.model == "fisheye" and _widest_angle(given, (fx, fy, cx, cy), width, height) > EWA_ANGLE
    return SplatCamera(
        to_camera, (fx, fy, cx, cy), width, height, near, look.blur, look.antialiased, lens, camera.model,
        look.sort == "depth", wide,
    )  # fmt: skip


@lru_cache(maxsize=16)
def _flipped(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return FLIPPED (3, 3), cached for each device: a copy to a device synchronises."""
    return torch.tensor(FLIPPED, dtype=dtype, device=device)


@lru_cache(maxsize=1024)
def _lens(model: str, coefficients: tuple[float, ...]) -> Distortion:
    """Return the distortion of a lens, cached: its range of validity is found by a slow iteration."""
    return Distortion.of(model, torch.tensor([coefficients], dtype=torch.float64))


@lru_cache(maxsize=1024)
def _widest_angle(
    coefficients: tuple[float, ...], intrinsics: tuple[float, float, float, float], width: int, height: int
) -> float:
    """Return the largest angle, radians, from a fisheye's axis that an image shows: at a corner, or the lens's
    reach."""
    fx, fy, cx, cy = intrinsics
    across = torch.tensor([-cx, width - cx, -cx, width - cx], dtype=torch.float64) / fx
    down = torch.tensor([-cy, -cy, height - cy, height - cy], dtype=torch.float64) / fy
    x, y, _ = undistort(across, down, _lens("fisheye", coefficients)[torch.zeros(4, dtype=torch.int64)])
    return float(torch.hypot(x, y).max())


def ray_directions(camera: SplatCamera) -> Tensor:
    """Return the unit directions (H, W, 3) of the rays through an image's pixels, in the scene's frame.

    They have no gradient. A pixel without a ray has some finite direction.

    Args:
        camera: the image.
    """
    c, pose = camera, camera.pose.detach()
    model = "pinhole" if c.lens is None and c.model in DISTORTED else c.model
    return _local_directions(c.width, c.height, c.intrinsics, c.lens, model, pose.device).to(pose) @ pose[:, :3]


@lru_cache(maxsize=4)
def _local_directions(
    width: int,
    height: int,
    intrinsics: tuple[float, float, float, float],
    lens: Distortion | None,
    model: str,
    device: torch.device,
) -> Tensor:
    """Return unit directions (H, W, 3) in the camera's frame, cached: inverting the distortion is slow."""
    fx, fy, cx, cy = intrinsics
    rows, columns = torch.arange(height) + 0.5, torch.arange(width) + 0.5
    y, x = (part.flatten() for part in torch.meshgrid((rows - cy) / fy, (columns - cx) / fx, indexing="ij"))
    lenses = None if lens is None else lens[torch.zeros(len(x), dtype=torch.long)]
    upwards = unproject(model, x, y, lenses).directions  # x right, y up, looking along -z
    return (upwards @ torch.tensor(FLIPPED)).view(height, width, 3).to(device)


@torch.no_grad()
def draw_colors(gaussians: Gaussians, camera: SplatCamera, stride: int, background: Tensor) -> Tensor:
    """Draw the colours (H, W, 3) of a picture alone, which takes less time than `draw_view`.

    Args:
        camera: the whole image.
        stride: distance between the rows and columns that are kept, pixels.
        background: (3,) colour behind everything.
    """
    return every(RASTERISER.draw(RASTERISER.project(gaussians, camera), camera, background).image, stride)


@torch.no_grad()
def draw_view(
    gaussians: Gaussians, camera: SplatCamera, stride: int, background: Tensor, far: float,
    rasteriser: Rasteriser = RASTERISER,
) -> Picture:  # fmt: skip
    """Draw a picture with depth, opacity and normals.

    Args:
        camera: the whole image.
        stride: distance between the rows and columns that are kept, pixels.
        background: (3,) colour behind everything.
        far: depth of empty pixels, scene units.
    """
    return picture_of(rasteriser.project(gaussians, camera), camera, stride, background, far, rasteriser)


@torch.no_grad()
def picture_of(
    shown: Projected, camera: SplatCamera, stride: int, background: Tensor, far: float,
    rasteriser: Rasteriser = RASTERISER,
) -> Picture:  # fmt: skip
    """Draw a picture with depth, opacity and normals of projected Gaussians.

    Args:
        shown: the Gaussians on the whole image.
        camera, stride, background, far: as in `draw_view`.
    """
    image, through, median = rasteriser.draw(shown, camera, background, CHANNELS["normals"], median=True)
    assert median is not None
    opacity = 1 - through
    depth = torch.where(opacity > 1e-6, image[..., 3] / opacity.clamp(min=1e-6), far)
    normals = torch.nn.functional.normalize(image[..., 4:7], dim=-1)
    parts = (image[..., :3], depth, torch.where(median > 0, median, far), opacity, normals)
    rgb, depth, median, opacity, normals = (every(part, stride) for part in parts)
    return Picture(rgb, depth, median, opacity, {NORMALS.name: normals}, (NORMALS,))
