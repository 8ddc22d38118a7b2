"""Crops of views: pictures of the scene within a box and polygons, and between two distances from the camera."""

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

BY_RAYS = "Only matter inside the crop is rendered, so its walls hide nothing."
BY_CENTERS = "Only Gaussians with their centre inside the crop are drawn, so its walls hide nothing."
BY_DEPTH = "Pixels with their surface outside the crop are hidden, with everything behind them."
SHORTEST = 1e-6
"""Minimum length of a part of a ray, relative to the distance of its end; a shorter one is rounding."""


@dataclass(frozen=True)
class CroppedCameras(Cameras):
    """Cameras with rays that start and end where they enter and leave a crop."""

    crop: Crop | None = None
    """The crop; None for whole rays."""
    part: int = 0
    """Index of the part of each ray within the crop, from the camera on (`parts_within`)."""

    @classmethod
    def of(cls, cameras: Cameras, crop: Crop, part: int = 0) -> CroppedCameras:
        """Return `cameras` with a `part` of their rays within the `crop`."""
        return cls(**{field.name: getattr(cameras, field.name) for field in fields(Cameras)}, crop=crop, part=part)

    def pixel_rays(
        self, flat: Tensor, near: float, far: float, times: Tensor | None = None, subpixels: Tensor = CENTER
    ) -> Rays:
        rays = super().pixel_rays(flat, near, far, times, subpixels)
        if self.crop is None:
            return rays
        parts = parts_within(rays, self.crop)
        return parts[self.part] if self.part < len(parts) else replace(rays, nears=rays.fars)


def views_within(view: View, crop: Crop | None, column: float, row: float, near: float, far: float) -> list[View]:
    """Return a `view` with the parts of its rays within `crop`, as many as the ray of a pixel has; the nearest first.

    Args:
        view: the view.
        crop: the crop; None for whole rays.
        column, row: the pixel.
        near, far: distances where whole rays start and end.
    """
    if crop is None:
        return [view]
    camera = view.camera
    ray = camera.rays(
        torch.zeros_like(camera.widths), camera.fx.new_tensor([column]), camera.fx.new_tensor([row]), near, far
    )
    return [replace(view, camera=CroppedCameras.of(camera, crop, part)) for part in range(len(parts_within(ray, crop)))]


def parts_within(rays: Rays, crop: Crop) -> list[Rays]:
    """Return the parts of `rays` within a `crop`, at least one, the nearest first.

    A ray that has fewer parts than others has a part of length 0 in their place. A crop without polygons is convex, so
    each ray has one part in it.
    """
    whole = _within_box(rays, crop)
    if not crop.polygons:
        return [whole]
    near, far = whole.nears[:, None], whole.fars[:, None]
    found = torch.cat([polygon.crossings(rays.origins, rays.directions) for polygon in crop.polygons], -1)
    ends = torch.cat([near, found.nan_to_num(nan=0.0), far], -1)
    ends = torch.minimum(torch.maximum(ends, near), far).sort(-1).values
    inside = torch.zeros_like(ends[:, 1:], dtype=torch.bool)
    before = inside[:, 0]
    for number, (start, end) in enumerate(zip(ends.T[:-1], ends.T[1:], strict=True)):
        middle = rays.origins + ((start + end) / 2)[:, None] * rays.directions
        before = torch.where(end - start > SHORTEST * end, crop.contains(middle), before)
        inside[:, number] = before
    begins = inside.clone()
    begins[:, 1:] &= ~inside[:, :-1]
    numbers = begins.cumsum(-1)
    parts = []
    for number in range(1, max(int(numbers[:, -1].max()) if len(rays) else 1, 1) + 1):
        of_part = inside & (numbers == number)
        missed = ~of_part.any(-1)
        nears = torch.where(of_part, ends[:, :-1], torch.inf).amin(-1)
        fars = torch.where(of_part, ends[:, 1:], -torch.inf).amax(-1)
        nears, fars = torch.where(missed, rays.fars, nears), torch.where(missed, rays.fars, fars)
        parts.append(replace(rays, nears=nears, fars=fars))
    return parts


def _within_box(rays: Rays, crop: Crop) -> Rays:
    """Return `rays` within the box and the distances of a `crop`; rays that miss it have length 0."""
    nears, fars = rays.nears.clamp(min=crop.near), rays.fars.clamp(max=crop.far)
    if crop.box is not None:
        corners = rays.origins.new_tensor([crop.box.low, crop.box.high])
        enter, leave = intersect_box(crop.box.along(rays.origins), crop.box.along(rays.directions), corners)
        nears, fars = torch.maximum(nears, enter), torch.minimum(fars, leave)
        fars = torch.where(leave <= enter, nears, fars)
    return replace(rays, nears=torch.minimum(nears, rays.fars), fars=torch.maximum(fars, nears).minimum(rays.fars))


def picture_within(model: Renderable, view: View, crop: Crop, background: Tensor) -> Picture:
    """Return a picture (H, W) by `model` of a `view` of stride 1 inside `crop`, over `background` (3,).

    `meaning` describes it for each kind of model.
    """
    camera = view.camera
    if isinstance(model, RendersGaussians):
        found = model.gaussians(view.time)
        return model.render_gaussians(found[within(found.means, camera, crop)], view, background)
    rays = camera.pixel_rays(camera.image_pixels(0), model.scene.near, model.scene.far)
    parts = parts_within(rays, crop)
    if not isinstance(model, RendersRays):
        picture = model.render_view(view, background)
        depth = picture.median_depth.reshape(-1)
        shown = [(part.fars > part.nears) & (depth >= part.nears) & (depth <= part.fars) for part in parts]
        return _only(picture, torch.stack(shown).any(0), background)
    pictures = [
        _only(
            model.render_view(replace(view, camera=CroppedCameras.of(camera, crop, number)), background),
            part.fars > part.nears,
            background,
        )
        for number, part in enumerate(parts)
    ]
    whole = pictures.pop()
    while pictures:
        whole = _over(pictures.pop(), whole, background)
    return whole


def _only(picture: Picture, shown: Tensor, background: Tensor) -> Picture:
    """Return a picture (H, W) with the background (3,) where pixels are not `shown` (H * W,)."""
    hidden = ~shown.view(picture.size)
    return replace(
        picture,
        rgb=torch.where(hidden[..., None], background, picture.rgb),
        accumulation=torch.where(hidden, torch.zeros_like(picture.accumulation), picture.accumulation),
    )


def _over(front: Picture, back: Picture, background: Tensor) -> Picture:
    """Return a picture of two parts of each ray, both over the background (3,).

    Colour, opacity and expected depth are those of the whole rays. The median depth and further outputs of a pixel are
    those of the part that brings its opacity to one half.
    """
    clear = 1 - front.accumulation
    accumulation = front.accumulation + clear * back.accumulation
    share = front.accumulation / accumulation.clamp(min=1e-6)
    is_front = front.accumulation >= 0.5
    extras = {
        name: torch.where(is_front.view(*is_front.shape, *(1,) * (values.dim() - 2)), front.extras[name], values)
        for name, values in back.extras.items()
    }
    return replace(
        back,
        rgb=front.rgb + clear[..., None] * (back.rgb - background),
        depth=torch.lerp(back.depth, front.depth, share),
        median_depth=torch.where(is_front, front.median_depth, back.median_depth),
        accumulation=accumulation,
        extras=extras,
        num_rays=front.num_rays + back.num_rays,
    )


def meaning(model: Renderable) -> str:
    """Return a description of a crop's effect on pictures of `model`."""
    if isinstance(model, RendersGaussians):
        return BY_CENTERS
    return BY_RAYS if isinstance(model, RendersRays) else BY_DEPTH


def within(points: Tensor, camera: Cameras, crop: Crop) -> Tensor:
    """Return whether `points` (N, 3) lie within `crop`, with distances from `camera`, as (N,) bool."""
    distances = (points - camera.camera_to_worlds[0, :, 3]).norm(dim=-1)
    return crop.contains(points) & (distances >= crop.near) & (distances <= crop.far)
