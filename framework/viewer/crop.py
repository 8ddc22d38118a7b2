"""Crop boxes of views: pictures of the scene within a box, and between two distances from the camera."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from nerfloom.cameras.cameras import CENTER, Cameras
from nerfloom.cameras.view import View
from nerfloom.geometry.bounds import intersect_box
from nerfloom.geometry.rays import Rays
from nerfloom.renderable import Renderable, RendersRays
from nerfloom.rendering.rendered import Picture
from nerfloom.splats.gaussians import RendersGaussians
from nerfloom.viewer.request import Crop

BY_RAYS = "Only matter inside the box is rendered, so its walls hide nothing."
BY_CENTERS = "Only Gaussians with their centre inside the box are drawn, so its walls hide nothing."
BY_DEPTH = "Pixels with their surface outside the box are hidden, with everything behind them."


@dataclass(frozen=True)
class CroppedCameras(Cameras):
    """Cameras with rays that start and end where they enter and leave a box, and between two distances."""

    crop: Crop | None = None
    """The box and the distances; None for whole rays."""

    @classmethod
    def of(cls, cameras: Cameras, crop: Crop) -> CroppedCameras:
        """Return `cameras` with rays that end at the `crop`."""
        return cls(**{field.name: getattr(cameras, field.name) for field in fields(Cameras)}, crop=crop)

    def pixel_rays(
        self, flat: Tensor, near: float, far: float, times: Tensor | None = None, subpixels: Tensor = CENTER
    ) -> Rays:
        rays = super().pixel_rays(flat, near, far, times, subpixels)
        return rays if self.crop is None else cropped(rays, self.crop)


def cropped(rays: Rays, crop: Crop) -> Rays:
    """Return `rays` that start and end within `crop`, a box and distances; rays that miss it have length 0."""
    box, corners = crop.box, rays.origins.new_tensor([crop.box.low, crop.box.high])
    enter, leave = intersect_box(box.along(rays.origins), box.along(rays.directions), corners)
    missed = leave <= enter
    nears = torch.maximum(rays.nears, enter).clamp(min=crop.near)
    fars = torch.minimum(rays.fars, leave).clamp(max=crop.far)
    fars = torch.where(missed, nears, fars)
    return replace(rays, nears=torch.minimum(nears, rays.fars), fars=torch.maximum(fars, nears).minimum(rays.fars))


def without_outside(picture: Picture, rays: Rays, crop: Crop, background: Tensor, by_depth: bool) -> Picture:
    """Return a picture with the background in pixels outside a crop.

    Args:
        picture: (H, W) rendered view.
        rays: H * W whole rays of the pixels' centres.
        crop: the box and the distances.
        background: (3,) colour.
        by_depth: whether to hide pixels with a surface, at the median depth, outside, with everything behind it.
            For methods that cast no rays.
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


def picture_within(model: Renderable, view: View, crop: Crop, background: Tensor) -> Picture:
    """Return a picture (H, W) by `model` of a `view` of stride 1 inside `crop`, over `background` (3,).

    `meaning` describes it for each kind of model.
    """
    camera = view.camera
    if isinstance(model, RendersGaussians):
        found = model.gaussians(view.time)
        return model.render_gaussians(found[within(found.means, camera, crop)], view, background)
    rays = camera.pixel_rays(camera.image_pixels(0), model.scene.near, model.scene.far)
    if not isinstance(model, RendersRays):
        return without_outside(model.render_view(view, background), rays, crop, background, by_depth=True)
    picture = model.render_view(replace(view, camera=CroppedCameras.of(camera, crop)), background)
    return without_outside(picture, rays, crop, background, by_depth=False)


def meaning(model: Renderable) -> str:
    """Return a description of a crop's effect on pictures of `model`."""
    if isinstance(model, RendersGaussians):
        return BY_CENTERS
    return BY_RAYS if isinstance(model, RendersRays) else BY_DEPTH


def within(points: Tensor, camera: Cameras, crop: Crop) -> Tensor:
    """Return whether `points` (N, 3) lie within `crop`, with distances from `camera`, as (N,) bool."""
    distances = (points - camera.camera_to_worlds[0, :, 3]).norm(dim=-1)
    return crop.box.contains(points) & (distances >= crop.near) & (distances <= crop.far)
