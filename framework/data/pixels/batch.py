"""Batches of training pixels; rays are computed only for the drawn pixels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import torch
from torch import Tensor

from nerfloom.cameras.cameras import CENTER
from nerfloom.cameras.view import View
from nerfloom.data.dataset import Dataset
from nerfloom.data.depths import ray_distances
from nerfloom.data.scene import Scene
from nerfloom.geometry.rays import Rays
from nerfloom.kernels import native
from nerfloom.kernels.argument_checks import check_indices
from nerfloom.kernels.dispatch import CPP, Operation

Background = Literal["random", "white", "black"]
"""Kind of background."""
LookUp = Callable[[Tensor], Tensor]
"""Function from pixels (R,) int64 to their stored colours (R, 3 or 4) uint8."""


@dataclass(frozen=True)
class PixelBatch:
    """R pixels to train on."""

    pixels: Tensor
    """(R,) int64 numbers of the pixels, counted over all images."""
    rays: Rays
    """R * K rays, with the K rays of a pixel consecutive; if K is 1, they pass through the pixel's centre."""
    rgb: Tensor
    """(R, 3) colours over `background`."""
    background: Tensor
    """(R, 3) colours behind transparent pixels."""
    alpha: Tensor | None
    """(R,) opacity, if the images have alpha."""
    distances: Tensor | None = None
    """(R,) known distance along the pixel's ray, 0 where unknown; None if no pixel has one."""
    deviations: Tensor | None = None
    """(R,) standard deviation of `distances`, if these come from a reconstruction's points; None if depth images
    measured them."""
    clear: Tensor | None = None
    """(R,) length of the empty space in front of the camera, shown by the pixel's image; None if unknown."""
    weights: Tensor | None = None
    """(R,) factors of the pixels' losses, with mean 1, if pixels differ in size; 0 for pixels that do not count."""

    def __len__(self) -> int:
        return self.pixels.shape[0]

    def __getitem__(self, chosen: Tensor) -> PixelBatch:
        """Return the pixels of a mask (R,) bool, or of indices (Q,) int64, with their rays."""
        index = chosen.nonzero().squeeze(-1) if chosen.dtype is torch.bool else chosen
        of_pixels = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "rays"}
        some: dict[str, Any] = {name: value[index] for name, value in of_pixels.items() if value is not None}
        per_pixel = self.rays_per_pixel
        rays = (index[:, None] * per_pixel + torch.arange(per_pixel, device=index.device)).view(-1)
        return replace(self, rays=self.rays[rays], **some)

    @property
    def rays_per_pixel(self) -> int:
        """Number K of rays per pixel."""
        return max(len(self.rays) // max(len(self), 1), 1)


@dataclass(frozen=True)
class ViewBatch:
    """One whole training image, or one that a teacher has rendered."""

    index: int | None
    """Index of the training image; None for a view of a teacher."""
    view: View
    """Its camera."""
    rgb: Tensor
    """(H, W, 3) colours over `background`."""
    background: Tensor
    """(3,) colour behind transparent pixels."""
    alpha: Tensor | None = None
    """(H, W) opacity, if the images have alpha."""
    weights: Tensor | None = None
    """(H, W) factors of the pixels' losses, from 0 for pixels that do not count to 1; None for 1."""
    distances: Tensor | None = None
    """(H, W) distance along each pixel's ray, 0 where unknown: measured, or from a reconstruction's points; None if
    none is known."""

    def __len__(self) -> int:
        return self.rgb.shape[0] * self.rgb.shape[1]


def training_background(asked: Background | Literal["auto"], scene: Scene) -> Background:
    """Return the background in training: the `asked` one, or for "auto" random or black.

    Where images have alpha, a fixed background could be learnt as matter. Where every ray ends in the box, a fixed one
    could stand for dark matter, and fog before a camera need not be opaque.

    Args:
        asked: the setting.
    """
    if asked != "auto":
        return asked
    return "random" if scene.has_alpha or scene.ends_in_box else "black"


def background_colors(kind: Background, count: int, device: torch.device) -> Tensor:
    """Return background colours (count, 3) in [0, 1].

    Args:
        kind: "random" gives each pixel its own colour, so that no fixed background can be learnt.
        count: number of pixels.
        device: device of the result.
    """
    if kind == "random":
        return torch.rand(count, 3, device=device)
    return torch.full((count, 3), 1.0 if kind == "white" else 0.0, device=device)


def composite(rgba: Tensor, background: Tensor) -> Tensor:
    """Composite straight-alpha colours `rgba` (R, 4) over `background` (R, 3); colours (R, 3) stay unchanged."""
    if rgba.shape[-1] == 3:
        return rgba
    return rgba[..., :3] * rgba[..., 3:] + background * (1 - rgba[..., 3:])


def draw_pixels(dataset: Dataset, count: int) -> Tensor:
    """Draw `count` pixels of `dataset` uniformly from `drawn`, with replacement, by PyTorch's generator."""
    device = dataset.pixels.device
    if dataset.drawn is None:
        return torch.randint(len(dataset.pixels), (count,), device=device)
    return dataset.drawn.at(torch.randint(len(dataset.drawn), (count,), device=device))


def draw_from_images(dataset: Dataset, count: int, num_images: int) -> Tensor:
    """Draw `count` pixels of `dataset`, equally many from each of `num_images` random images, by torch's generator.

    They are in ascending order: rays of pixels that are close together meet the same part of a model's memory.
    """
    drawn, ends = dataset.drawn, dataset.cameras.offsets.to(dataset.pixels.device)
    ranks = ends if drawn is None else drawn.ranks(ends)
    sizes = ranks.diff()
    some = sizes.nonzero()[:, 0]
    images = some[torch.randint(len(some), (min(num_images, count),), device=some.device)]
    images = images.repeat(-(-count // len(images)))[:count].sort().values
    place = torch.randint(2**62, (count,), device=some.device)  # a range so large that the remainder has no bias
    chosen = (ranks[images] + place % sizes[images]).sort().values
    return chosen if drawn is None else drawn.at(chosen)


def draw_batch(
    dataset: Dataset,
    count: int,
    background: Background,
    subpixels: Tensor = CENTER,
    look_up: LookUp | None = None,
    keypoints: int = 0,
    num_images: int | None = None,
) -> PixelBatch:
    """Draw a batch of pixels.

    Pixels with a sparse depth are few, so some are drawn in addition: each gives the distance of its surface, and empty
    space before it. Their colours count like all others.

    Args:
        dataset: the training images.
        count: number of pixels R.
        background: kind of background.
        subpixels: (K, 2) positions of the rays in a pixel, as in `Cameras.pixel_rays`.
        look_up: for pixels in a file, a function that returns the stored colours of all drawn pixels, in the order of
            drawing (`PixelStream.look_up`).
        keypoints: number of pixels drawn from `dataset.sparse_depth`; they are the last ones.
        num_images: number of images that the other pixels come from; None for all.
    """
    uniform, sparse = count - keypoints, dataset.sparse_depth
    # Pixels are drawn before any other random number, so that `PixelStream` can predict them from the seed.
    flat = draw_pixels(dataset, uniform) if num_images is None else draw_from_images(dataset, uniform, num_images)
    stored = None
    if not dataset.resident:
        stored = dataset.stored(flat) if look_up is None else look_up(flat).to(dataset.device)
        flat = flat.to(dataset.device)
    behind = background_colors(background, count, dataset.device)
    if not keypoints or sparse is None:
        return gather_batch(dataset, flat, behind, subpixels, stored)
    chosen = torch.randint(len(sparse), (keypoints,), device=dataset.device)
    if stored is not None:
        stored = torch.cat([stored, dataset.stored(sparse.pixels[chosen])])
    batch = gather_batch(dataset, torch.cat([flat, sparse.pixels[chosen]]), behind, subpixels, stored)
    distances, deviations = (
        torch.cat([values.new_zeros(uniform), values[chosen]]) for values in (sparse.distances, sparse.deviations)
    )
    return replace(batch, distances=distances, deviations=deviations)


def gather_batch(
    dataset: Dataset, flat: Tensor, behind: Tensor, subpixels: Tensor = CENTER, stored: Tensor | None = None
) -> PixelBatch:
    """Construct a batch from given pixels.

    Args:
        flat: (R,) numbers of the pixels, counted over all images.
        behind: (R, 3) background colours.
        subpixels: (K, 2) positions of the rays in a pixel.
        stored: (R, 3 or 4) uint8 stored colours; looked up if None.
    """
    scene = dataset.scene
    rays = dataset.cameras.pixel_rays(flat, scene.near, scene.far, dataset.times, subpixels)
    if stored is None and not dataset.resident:
        stored = dataset.stored(flat)
    if stored is None:
        rgb, alpha = gather_colors(dataset.pixels, flat, behind)
    else:
        rgb, alpha = gather_colors(stored, torch.arange(len(flat), device=flat.device), behind)
    if dataset.opaque is not None:
        opaque = dataset.opaque.contains(flat)
        rgb, alpha = torch.where(opaque[:, None], rgb, behind), opaque * (1.0 if alpha is None else alpha)
    weights = None
    if dataset.image_weights is not None and rays.camera_indices is not None:
        weights = dataset.image_weights[rays.camera_indices[:: len(subpixels)]]
    return PixelBatch(flat, rays, rgb, behind, alpha, known_distances(dataset, flat, rays), weights=weights)


def known_distances(dataset: Dataset, flat: Tensor, rays: Rays) -> Tensor | None:
    """Return the measured distance (R,) along the rays of pixels, 0 where unknown; None without depth images.

    Args:
        flat: (R,) numbers of the pixels, counted over all images.
        rays: R * K rays through the pixels, with the K rays of a pixel consecutive.
    """
    if dataset.depths is None or rays.camera_indices is None:
        return None
    per_pixel = len(rays) // max(len(flat), 1)
    cameras = rays.camera_indices[::per_pixel] if len(flat) else rays.camera_indices
    directions = rays.directions.view(len(flat), per_pixel, 3).mean(1)
    poses = dataset.cameras.camera_to_worlds[cameras]
    return ray_distances(dataset.depths[flat], torch.nn.functional.normalize(directions, dim=-1), poses)


def gather_colors_reference(pixels: Tensor, flat: Tensor, behind: Tensor) -> tuple[Tensor, Tensor | None]:
    """Compute `gather_colors` of `pixels`, `flat` and `behind` in PyTorch, on any device."""
    check_indices(flat, len(pixels), "pixels")
    rgba = pixels[flat].float() / 255
    return composite(rgba, behind), rgba[:, 3] if rgba.shape[-1] == 4 else None


def gather_colors(pixels: Tensor, flat: Tensor, behind: Tensor) -> tuple[Tensor, Tensor | None]:
    """Return the colours of pixels over a background.

    Args:
        pixels: (P, 3 or 4) uint8 stored pixels; the fourth channel is straight alpha.
        flat: (R,) numbers of the pixels.
        behind: (R, 3) background colours.

    Returns:
        Colours (R, 3), and opacities (R,), or None for three channels.

    Raises:
        IndexError: if a number exceeds the number of pixels.
    """
    return GATHER_COLORS((behind,), pixels, flat, behind)


GATHER_COLORS = Operation("gather_colors", gather_colors_reference)


@GATHER_COLORS.implementation(CPP, order=0)
def _compiled(pixels: Tensor, flat: Tensor, behind: Tensor) -> tuple[Tensor, Tensor | None]:
    count, channels = len(flat), pixels.shape[1]
    rgb, alpha = torch.empty(count, 3), torch.empty(count)
    _gather_colors(
        native.pointer(flat, "pixel indices", (count,), torch.int64), count,
        native.pointer(pixels, "pixels", (len(pixels), channels), torch.uint8), len(pixels), channels,
        native.pointer(behind, "the background", (count, 3)), rgb.data_ptr(), alpha.data_ptr(), native.threads(),
    )  # fmt: skip
    return rgb, alpha if channels == 4 else None


_gather_colors = native.Function("gather_colors", "pqpqipppi")


def view_colors_reference(pixels: Tensor, behind: Tensor) -> tuple[Tensor, Tensor | None]:
    """Compute `view_colors` of `pixels` and `behind` in PyTorch, on any device."""
    rgba = pixels.float() / 255
    return composite(rgba, behind), rgba[..., 3] if rgba.shape[-1] == 4 else None


def view_colors(pixels: Tensor, behind: Tensor) -> tuple[Tensor, Tensor | None]:
    """Return the colours of a whole image over one background colour.

    Args:
        pixels: (H, W, 3 or 4) uint8 stored pixels; the fourth channel is straight alpha.
        behind: (3,) background colour.

    Returns:
        Colours (H, W, 3), and opacities (H, W), or None for three channels.
    """
    return VIEW_COLORS((behind,), pixels, behind)


VIEW_COLORS = Operation("view_colors", view_colors_reference)


@VIEW_COLORS.implementation(CPP, order=0)
def _compiled_view(pixels: Tensor, behind: Tensor) -> tuple[Tensor, Tensor | None]:
    pixels, behind = pixels.contiguous(), behind.contiguous()  # kept until the kernel has read them
    height, width, channels = pixels.shape
    rgb, alpha = torch.empty(height, width, 3), torch.empty(height, width) if channels == 4 else None
    _view_colors(
        native.pointer(pixels, "the image", (height, width, channels), torch.uint8), height * width, channels,
        native.pointer(behind, "the background", (3,)), rgb.data_ptr(), None if alpha is None else alpha.data_ptr(),
        native.threads(),
    )  # fmt: skip
    return rgb, alpha


_view_colors = native.Function("view_colors", "pqipppi")
