"""Pictures of Gaussians: from a camera of the framework to an image and what is seen in it."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from nerfloom.base.errors import ConfigError
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.view import every
from nerfloom.data.scene import Scene
from nerfloom.geometry.lenses import LENSES, Distortion
from nerfloom.kernels.splats.blend import CHANNELS, Blended, blend
from nerfloom.kernels.splats.project import SplatCamera, project_gaussians, sort_keys
from nerfloom.kernels.splats.tiles import tile_lists
from nerfloom.rendering.outputs import NORMALS
from nerfloom.rendering.rendered import Picture
from nerfloom.splats.capacity import Room
from nerfloom.splats.gaussians import MAX_DEGREE, Gaussians
from nerfloom.splats.look import OURS, Look

DRAWN = ("pinhole", "opencv", "fisheye")
"""Camera models that Gaussians can be drawn for."""
FLIPPED = ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0))
"""From a camera's axes (x right, y up, looking along -z) to those of splatting (x right, y down, z forward)."""


def smallest_depth(scene: Scene) -> float:
    """Return the depth, scene units, below which the centres of Gaussians are not drawn.

    Args:
        scene: the scene.
    """
    return max(0.2 * scene.near, 1e-3)


def splat_camera(
    camera: Cameras, near: float, look: Look = OURS, pose: Tensor | None = None, reduced: int = 1
) -> SplatCamera:
    """Return a camera as splatting sees it.

    Args:
        camera: one camera.
        near: what is nearer to it along its axis is not drawn, scene units.
        look: how Gaussians are drawn.
        pose: (3, 4) camera-to-scene pose to use instead of its own; it may require a gradient.
        reduced: factor by which the image is smaller than the camera's.

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
    """Return FLIPPED (3, 3), which is kept: bringing it to a device means to wait for it."""
    return torch.tensor(FLIPPED, dtype=dtype, device=device)


@lru_cache(maxsize=1024)
def _lens(model: str, coefficients: tuple[float, ...]) -> Distortion:
    """Return the distortion of one lens. How far it reaches is found by iteration, which a training step has no time
    for."""
    return Distortion.of(model, torch.tensor([coefficients], dtype=torch.float64))


def on_image(gaussians: Gaussians, camera: SplatCamera, degree: int = MAX_DEGREE) -> Tensor:
    """Return the Gaussians on an image, records (N, RECORD) as `project_gaussians` gives them, with a gradient.

    Args:
        gaussians: what is drawn.
        camera: the image.
        degree: highest degree of the harmonics that counts.
    """
    g = gaussians
    return project_gaussians(
        g.means, g.log_scales, g.rotations, g.logits, g.colors, g.harmonics, camera=camera, degree=degree
    )[0]


def draw(
    records: Tensor,
    camera: SplatCamera,
    background: Tensor,
    channels: int = CHANNELS["rgb"],
    room: Room | None = None,
    keys: Tensor | None = None,
) -> Blended:
    """Blend Gaussians on an image, with a gradient.

    Args:
        records: (N, RECORD) from `on_image`.
        camera: the image.
        background: (3,) colour behind everything.
        channels: number of channels, a value of `CHANNELS`.
        room: how many entries of lists a device that runs ahead of Python gets, which would be waited for otherwise.
        keys: (N,) what they are sorted by, from `sort_keys`; None for distance.

    Raises:
        ValueError: if the camera sorts by depth, and there are no keys.
    """
    if camera.by_depth and keys is None:
        raise ValueError("this camera sorts Gaussians by depth: give the keys that `sort_keys` returns")
    given = None if room is None else room.of(records, camera.width * camera.height)
    lists = tile_lists(records, camera.width, camera.height, torch.is_grad_enabled(), given, keys)
    if room is not None:
        room.note(records, camera.width * camera.height, lists)
    return blend(records, lists, camera.width, camera.height, background, channels)


@torch.no_grad()
def draw_colors(gaussians: Gaussians, camera: SplatCamera, stride: int, background: Tensor) -> Tensor:
    """Draw the colours (H, W, 3) of a picture alone, which takes less time than `draw_view`.

    Args:
        gaussians: what is drawn.
        camera: the whole image.
        stride: distance between the rows and columns that are kept, pixels.
        background: (3,) colour behind everything.
    """
    keys = sort_keys(gaussians.means, camera)
    return every(draw(on_image(gaussians, camera), camera, background, keys=keys).image, stride)


@torch.no_grad()
def draw_view(gaussians: Gaussians, camera: SplatCamera, stride: int, background: Tensor, far: float) -> Picture:
    """Draw a picture with depth, opacity and normals.

    Args:
        gaussians: what is drawn.
        camera: the whole image.
        stride: distance between the rows and columns that are kept, pixels.
        background: (3,) colour behind everything.
        far: depth where nothing is seen, scene units.
    """
    records, keys = on_image(gaussians, camera), sort_keys(gaussians.means, camera)
    lists = tile_lists(records, camera.width, camera.height, for_gradients=False, keys=keys)
    image, through, median = blend(
        records, lists, camera.width, camera.height, background, CHANNELS["normals"], median=True
    )
    assert median is not None
    opacity = 1 - through
    depth = torch.where(opacity > 1e-6, image[..., 3] / opacity.clamp(min=1e-6), far)
    normals = torch.nn.functional.normalize(image[..., 4:7], dim=-1)
    parts = (image[..., :3], depth, torch.where(median > 0, median, far), opacity, normals)
    rgb, depth, median, opacity, normals = (every(part, stride) for part in parts)
    return Picture(rgb, depth, median, opacity, {NORMALS.name: normals}, (NORMALS,))
