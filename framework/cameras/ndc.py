"""Normalised device coordinates: map the space that forward-facing cameras see, up to infinity, to a box.

NeRF (Mildenhall et al. 2020), appendix C. The map keeps rays straight, so that the usual rendering works in the box,
for the same pixels. Steps along a ray are uniform in disparity, not in distance. The scene is learnt in the box:
directions, depths and positions are in box coordinates, not in scene coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from nerfloom.base.errors import DataError
from nerfloom.cameras.cameras import CENTER, Cameras
from nerfloom.geometry.rays import Rays

MIN_AHEAD = 1e-3
"""Minimum cosine of the angle between a ray and the common axis; other rays do not reach the box."""


@dataclass(frozen=True)
class Ndc:
    """The frame of a camera in the middle of all cameras, and the frustum that is mapped to the box from -1 to 1.

    The fields are plain numbers, independent of any device.
    """

    frame: tuple[tuple[float, ...], ...]
    """3 x 4 transform from the scene's frame to the middle camera's, with OpenGL axes."""
    near: float
    """Distance along the axis of the plane that is mapped to z = -1, scene units; infinity is mapped to z = 1."""
    half_width: float
    """Half width of the frustum at depth 1."""
    half_height: float
    """Half height of the frustum at depth 1."""

    def warp(self, rays: Rays) -> Rays:
        """Transform `rays` from the scene's frame to the box.

        The new rays start at the near plane, and end at infinity or at `rays.fars`, a distance in the box. A ray that
        does not look along the common axis gets length 0.
        """
        frame = torch.tensor(self.frame, dtype=rays.origins.dtype, device=rays.origins.device)
        # Products and sums, because autocast would round a matrix product to bfloat16.
        origins = (frame[:, :3] * rays.origins[:, None, :]).sum(-1) + frame[:, 3]
        directions = (frame[:, :3] * rays.directions[:, None, :]).sum(-1)
        ahead = -directions[:, 2] > MIN_AHEAD
        depth = torch.where(ahead, -directions[:, 2], torch.ones_like(directions[:, 2]))
        slope = directions[:, :2] / depth[:, None]
        size = frame.new_tensor([self.half_width, self.half_height])
        start = (origins[:, :2] + (self.near + origins[:, 2:]) * slope) / (self.near * size)
        # The position at infinity depends on the direction alone.
        change = torch.cat([slope / size - start, torch.full_like(depth[:, None], 2.0)], dim=-1)
        length = change.norm(dim=-1)
        radii = rays.pixel_radii
        if radii is not None:  # a pixel has about the same width at all distances here; the radius is exact half way
            radii = radii / depth / self.half_width / (length / 2)
        return replace(
            rays,
            origins=torch.cat([start, torch.full_like(depth[:, None], -1.0)], dim=-1),
            directions=change / length[:, None],
            nears=torch.where(ahead, rays.nears, torch.zeros_like(length)),
            fars=torch.where(ahead, torch.minimum(length, rays.fars), torch.zeros_like(length)),
            pixel_radii=radii,
        )


@dataclass(frozen=True)
class NdcCameras(Cameras):
    """Cameras with rays in normalised device coordinates; near and far are distances there."""

    ndc: Ndc | None = None
    """The coordinates; None for rays in the scene's frame."""

    def rays(
        self,
        camera_indices: Tensor,
        columns: Tensor,
        rows: Tensor,
        near: float,
        far: float,
        times: Tensor | None = None,
    ) -> Rays:
        rays = super().rays(camera_indices, columns, rows, near, far, times)
        return rays if self.ndc is None else self.ndc.warp(rays)

    def pixel_rays(
        self, flat: Tensor, near: float, far: float, times: Tensor | None = None, subpixels: Tensor = CENTER
    ) -> Rays:
        return self.pixel_rays_reference(flat, near, far, times, subpixels)


def middle_frame(poses: Tensor) -> Tensor:
    """Return the transform (3, 4) from the scene to a camera with mean position and axes of `poses` (M, 3, 4)."""
    back = torch.nn.functional.normalize(poses[:, :, 2].mean(0), dim=0)
    up = poses[:, :, 1].mean(0)
    up = torch.nn.functional.normalize(up - (up @ back) * back, dim=0)
    rotation = torch.stack([torch.linalg.cross(up, back), up, back])
    return torch.cat([rotation, -(rotation @ poses[:, :, 3].mean(0))[:, None]], dim=-1)


def find_ndc(poses: Tensor, corners: Tensor, nears: Tensor) -> Ndc:
    """Return the normalised device coordinates of M cameras.

    Args:
        poses: (M, 3, 4) camera-to-world, scene coordinates.
        corners: (M, 4, 3) directions through the corners of the images, scene coordinates, of depth 1 in their camera.
        nears: (M,) depth before anything that the camera sees.

    Raises:
        DataError: if the cameras do not look the same way, or one camera is behind the near plane of another.
    """
    frame = middle_frame(poses)
    ahead = corners @ frame[:, :3].T
    positions = poses[:, :, 3] @ frame[:, :3].T + frame[:, 3]
    largest_depth = float(-positions[:, 2].min())
    near = float(-(positions[:, None] + nears[:, None, None] * ahead)[:, :, 2].max())
    if not bool((-ahead[:, :, 2] > MIN_AHEAD * ahead.norm(dim=-1)).all()) or near <= max(largest_depth, 0):
        raise DataError(
            "normalised device coordinates need cameras that all look the same way, in front of the scene; "
            "these cameras do not: use --ndc False"
        )
    slopes = (ahead[:, :, :2] / -ahead[:, :, 2:]).abs().reshape(-1, 2).amax(0)
    rows = tuple(tuple(row) for row in frame.tolist())
    return Ndc(rows, near, float(slopes[0]), float(slopes[1]))


def ndc_box(ndc: Ndc, poses: Tensor, corners: Tensor) -> Tensor:
    """Return the smallest box (2, 3) in `ndc` of all that cameras see, with `poses` and `corners` as in `find_ndc`."""
    origins = poses[:, None, :, 3].expand_as(corners).reshape(-1, 3)
    directions = torch.nn.functional.normalize(corners.reshape(-1, 3), dim=-1)
    zero = torch.zeros_like(origins[:, 0])
    rays = ndc.warp(Rays(origins, directions, zero, zero + torch.inf))
    # The frustum of a camera is convex and stays so in the box, so its corners determine its bounds.
    ends = torch.cat([rays.origins, rays.origins + rays.fars[:, None] * rays.directions])
    return torch.stack([ends.amin(0), ends.amax(0)])
