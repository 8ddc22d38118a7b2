"""Crop boxes of views: rays that start and end in a box, and pictures without what lies outside of it."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from framework.cameras.cameras import CENTER, Cameras
from framework.geometry.bounds import intersect_box
from framework.geometry.rays import Rays
from framework.rendering.rendered import Picture
from framework.viewer.request import Crop


@dataclass(frozen=True)
class CroppedCameras(Cameras):
    """Cameras whose rays start and end where they enter and leave a box, and between two distances."""

    crop: Crop | None = None
    """The box and the distances; None for whole rays."""

    @classmethod
    def of(cls, cameras: Cameras, crop: Crop) -> CroppedCameras:
        """Return `cameras` whose rays end at the `crop`."""
        return cls(**{field.name: getattr(cameras, field.name) for field in fields(Cameras)}, crop=crop)

    def pixel_rays(
        self, flat: Tensor, near: float, far: float, times: Tensor | None = None, subpixels: Tensor = CENTER
    ) -> Rays:
        rays = super().pixel_rays(flat, near, far, times, subpixels)
        return rays if self.crop is None else cropped(rays, self.crop)


def cropped(rays: Rays, crop: Crop) -> Rays:
    """Return rays that start and end within a crop; those that miss it have length 0.

    Args:
        rays: R rays.
        crop: the box and the distances.
    """
    enter, leave = intersect_box(rays.origins, rays.directions, rays.origins.new_tensor(crop.corners))
    missed = leave <= enter
    nears = torch.maximum(rays.nears, enter).clamp(min=crop.near)
    fars = torch.minimum(rays.fars, leave).clamp(max=crop.far)
    fars = torch.where(missed, nears, fars)
    return replace(rays, nears=torch.minimum(nears, rays.fars), fars=torch.maximum(fars, nears).minimum(rays.fars))


def without_outside(picture: Picture, rays: Rays, crop: Crop, background: Tensor, by_depth: bool) -> Picture:
    """Return a picture in which pixels outside a crop show the background.

    Args:
        picture: (H, W) rendered view.
        rays: H * W whole rays of the pixels' centres.
        crop: the box and the distances.
        background: (3,) colour.
        by_depth: also hide pixels whose surface, at the median depth, lies outside: for methods that cast no rays, of
            which what lies behind is then not seen either.
    """
    inside = cropped(rays, crop)
    hidden = inside.fars <= inside.nears
    if by_depth:
        depth = picture.median_depth.reshape(-1)
        hidden |= (depth < inside.nears) | (depth > inside.fars)
    hidden = hidden.view(picture.size)
    return replace(
        picture,
        rgb=torch.where(hidden[..., None], background, picture.rgb),
        accumulation=torch.where(hidden, torch.zeros_like(picture.accumulation), picture.accumulation),
    )
