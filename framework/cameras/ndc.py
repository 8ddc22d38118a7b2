"""Normalised device coordinates: all that cameras which look one way can see, out to infinity, in a box.

NeRF (Mildenhall et al. 2020), appendix C. A ray stays a straight line, so it may be rendered there as anywhere, pixel
by pixel as in the photographs; halves of its length count disparity, not distance. What is learnt lives in that box and
not in scene coordinates: directions, depths and positions are the box's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from framework.base.errors import DataError
from framework.cameras.cameras import CENTER, Cameras
from framework.geometry.rays import Rays

LEAST_AHEAD = 1e-3
"""Cosine between a ray and the common axis below which it leads nowhere in the box."""


@dataclass(frozen=True)
class Ndc:
    """The frame of a camera in the middle of all, and the pyramid that becomes the box from -1 to 1.

    Plain numbers, so that it belongs to no device.
    """

    frame: tuple[tuple[float, ...], ...]
    """3 x 4, from the scene's frame to one with OpenGL's axes."""
    near: float
    """Distance along the axis of the plane that becomes z = -1, scene units; infinity becomes z = 1."""
    half_width: float
    """Of the pyramid at depth 1."""
    half_height: float

    def warp(self, rays: Rays) -> Rays:
        """Rays of the scene's frame as rays of the box, from the near plane on; they end at infinity or `rays.fars`.

        A ray that does not look along the common axis has no length.
        """
        frame = torch.tensor(self.frame, dtype=rays.origins.dtype, device=rays.origins.device)
        # Products and sums rather than a matrix product, which autocast would round to bfloat16.
        origins = (frame[:, :3] * rays.origins[:, None, :]).sum(-1) + frame[:, 3]
        directions = (frame[:, :3] * rays.directions[:, None, :]).sum(-1)
        ahead = -directions[:, 2] > LEAST_AHEAD
        depth = torch.where(ahead, -directions[:, 2], torch.ones_like(directions[:, 2]))
        slope = directions[:, :2] / depth[:, None]
        size = frame.new_tensor([self.half_width, self.half_height])
        start = (origins[:, :2] + (self.near + origins[:, 2:]) * slope) / (self.near * size)
        # At infinity a ray is where its direction alone says.
        change = torch.cat([slope / size - start, torch.full_like(depth[:, None], 2.0)], dim=-1)
        length = change.norm(dim=-1)
        radii = rays.pixel_radii
        if radii is not None:  # a pixel is about as wide at all distances here; the cone is right half-way
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
    """Cameras whose rays are those of normalised device coordinates; near and far are distances there."""

    ndc: Ndc | None = None
    """None for rays of the scene's frame."""

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
        self, flat: Tensor, near: float, far: float, times: Tensor | None = None, places: Tensor = CENTER
    ) -> Rays:
        return self.pixel_rays_reference(flat, near, far, times, places)


def middle_frame(poses: Tensor) -> Tensor:
    """(3, 4) from the scene's frame to that of a camera at the mean position, with mean axes.

    Args:
        poses: (M, 3, 4) camera-to-world.
    """
    back = torch.nn.functional.normalize(poses[:, :, 2].mean(0), dim=0)
    up = poses[:, :, 1].mean(0)
    up = torch.nn.functional.normalize(up - (up @ back) * back, dim=0)
    turn = torch.stack([torch.linalg.cross(up, back), up, back])
    return torch.cat([turn, -(turn @ poses[:, :, 3].mean(0))[:, None]], dim=-1)


def find_ndc(poses: Tensor, corners: Tensor, nears: Tensor) -> Ndc:
    """Normalised device coordinates for M cameras.

    Args:
        poses: (M, 3, 4) camera-to-world, scene coordinates.
        corners: (M, 4, 3) directions through the corners of their images, scene coordinates, 1 long along their axes.
        nears: (M,) depth before which no camera sees anything.
    Raises: DataError where the cameras do not look the same way, or what they see begins beside other cameras.
    """
    frame = middle_frame(poses)
    ahead = corners @ frame[:, :3].T
    places = poses[:, :, 3] @ frame[:, :3].T + frame[:, 3]
    foremost = float(-places[:, 2].min())
    near = float(-(places[:, None] + nears[:, None, None] * ahead)[:, :, 2].max())
    if not bool((-ahead[:, :, 2] > LEAST_AHEAD * ahead.norm(dim=-1)).all()) or near <= max(foremost, 0):
        raise DataError(
            "normalised device coordinates are for cameras that look the same way, all in front of what they see, and "
            "these do not; use --ndc False"
        )
    slopes = (ahead[:, :, :2] / -ahead[:, :, 2:]).abs().reshape(-1, 2).amax(0)
    rows = tuple(tuple(row) for row in frame.tolist())
    return Ndc(rows, near, float(slopes[0]), float(slopes[1]))


def ndc_box(ndc: Ndc, poses: Tensor, corners: Tensor) -> Tensor:
    """(2, 3) the smallest box of normalised device coordinates that holds all that M cameras see.

    Args:
        poses, corners: as `find_ndc` takes them.
    """
    origins = poses[:, None, :, 3].expand_as(corners).reshape(-1, 3)
    directions = torch.nn.functional.normalize(corners.reshape(-1, 3), dim=-1)
    zero = torch.zeros_like(origins[:, 0])
    rays = ndc.warp(Rays(origins, directions, zero, zero + torch.inf))
    # What a camera sees is convex and stays so: corners at both ends tell it all.
    ends = torch.cat([rays.origins, rays.origins + rays.fars[:, None] * rays.directions])
    return torch.stack([ends.amin(0), ends.amax(0)])
