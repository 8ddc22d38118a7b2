"""Pictures of Gaussians from the framework's cameras."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.view import every
from nerfloom.data.scene import Scene
from nerfloom.geometry.lenses import LENSES, Distortion
from nerfloom.kernels.splats.blend import CHANNELS
from nerfloom.kernels.splats.project import SplatCamera
from nerfloom.rendering.outputs import NORMALS
from nerfloom.rendering.rendered import Picture
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import OURS, Look
from nerfloom.splats.rasteriser import RASTERISER, Projected, Rasteriser

DRAWN = ("pinhole", "opencv", "fisheye")
"""Camera models that Gaussians can be drawn with."""
FLIPPED = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
"""From a camera's axes (x right, y up, looking along -z) to those of splatting (x right, y down, z forward)."""


def smallest_depth(scene: Scene) -> float:
    """Return the depth, scene units, below which the centres of Gaussians are not drawn."""
    return max(0.2 * scene.near, 1e-3)


def splat_camera(
    camera: Cameras, near: float, look: Look = OURS, pose: Tensor | None = None, reduced: int = 1
) -> SplatCamera:
    """Return a camera in the form that the rasteriser takes.

    Args:
        camera: one camera.
        near: Gaussians at a smaller depth are not drawn, scene units.
        look: the settings of drawing.
        pose: (3, 4) camera-to-scene pose to use instead of its own; it may require a gradient.
        reduced: ratio of the camera's image size to the drawn one's.

    Raises:
        ConfigError: for a camera model that is not among `DRAWN`.
    """
    if camera.model not in DRAWN:
        raise ConfigError(
            f"Gaussians cannot be drawn for {camera.model} cameras, only for pinhole, opencv and fisheye; "
            "undistort the images first, or take a method that casts rays, such as nerfacto"
        )
    pose = camera.camera_to_worlds[0] if pose is None else pose
    rotation = _flipped(pose.dtype, pose.device) @ pose[:, :3].T
    to_camera = torch.cat([rotation, -(rotation @ pose[:, 3])[:, None]], 1)
    fx, fy, cx, cy = (value / reduced for value in camera.intrinsics[0])
    lens, fisheye = None, camera.model == "fisheye"
    if fisheye or (camera.lens is not None and LENSES[camera.model]):
        given = (0.0,) * len(LENSES[camera.model]) if camera.lens is None else tuple(camera.lens[0].tolist())
        lens = _lens(camera.model, given)
    height, width = (side // reduced for side in camera.sizes[0])
    return SplatCamera(
        to_camera, (fx, fy, cx, cy), width, height, near, look.blur, look.antialiased, lens, fisheye,
        look.sort == "depth",
    )  # fmt: skip


@lru_cache(maxsize=16)
def _flipped(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return FLIPPED (3, 3), cached for each device: a copy to a device synchronises."""
    return torch.tensor(FLIPPED, dtype=dtype, device=device)


@lru_cache(maxsize=1024)
def _lens(model: str, coefficients: tuple[float, ...]) -> Distortion:
    """Return the distortion of a lens, cached: its range of validity is found by a slow iteration."""
    return Distortion.of(model, torch.tensor([coefficients], dtype=torch.float64))


@torch.no_grad()
def draw_colors(
    gaussians: Gaussians, camera: SplatCamera, stride: int, background: Tensor, rasteriser: Rasteriser = RASTERISER
) -> Tensor:
    """Draw the colours (H, W, 3) of a picture alone, which takes less time than `draw_view`.

    Args:
        gaussians: the Gaussians.
        camera: the whole image.
        stride: distance between the rows and columns that are kept, pixels.
        background: (3,) colour behind everything.
    """
    return every(rasteriser.draw(rasteriser.project(gaussians, camera), camera, background).image, stride)


@torch.no_grad()
def draw_view(
    gaussians: Gaussians, camera: SplatCamera, stride: int, background: Tensor, far: float,
    rasteriser: Rasteriser = RASTERISER,
) -> Picture:  # fmt: skip
    """Draw a picture with depth, opacity and normals.

    Args:
        gaussians: the Gaussians.
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
