"""Blocks of a large scene in one picture: only the blocks near the camera, and only a few of them in memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from threading import Lock
from typing import NamedTuple

import torch
from torch import Tensor

from nerfloom.blocks.blend import blended, near_shares, visible_shares
from nerfloom.blocks.block import TrainedBlock
from nerfloom.blocks.colors import recolored, recolored_gaussians
from nerfloom.blocks.merge import merged, of_cell
from nerfloom.blocks.visibility import Visibility, points_in_view
from nerfloom.cameras.moved import moved_cameras
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.view import View
from nerfloom.data.scene import Scene
from nerfloom.renderable import Renderable, refined_cameras
from nerfloom.rendering.rendered import Picture
from nerfloom.splats.gaussians import Gaussians, HasGaussians
from nerfloom.splats.look import Look
from nerfloom.splats.transform import transformed

KEPT = 4
"""Number of blocks in memory; where a grid of blocks overlaps, a place is in four of them."""
MIN_SHARE = 1e-3
"""Blocks with a smaller share are not drawn. It changes a colour by about a quarter of a step of 8 bits."""
LOOK_SIDE = 16
"""Shorter side of the pictures that tell how much of a view a block shows, pixels."""


class Opened(NamedTuple):
    """A block that is in memory."""

    model: Renderable
    """Its model, on its device."""
    placement: Placement
    """Placement of the input in the model's scene."""


def unknown_visibility(number: int) -> Visibility | None:
    """Return None: the block `number` has no visibility network."""
    return None


class Blocks(Renderable):
    """Several blocks of a scene in one picture: Block-NeRF (Tancik et al. 2022, arXiv:2202.05263), section 4.3.

    Blocks within reach of the camera are rendered, and blended by their inverse distance. Frames are converted in
    float64 by the blocks' placements, so blocks need not share one. Views are in the frame of the data's cameras; each
    block sees them where its own refined poses lead. Blocks that do not show a view are left out, by their visibility
    networks, or else by the mean opacity of a small picture of each.
    """

    def __init__(
        self,
        blocks: Sequence[TrainedBlock],
        opened: Callable[[int], Opened],
        placement: Placement,
        scene: Scene,
        visibility: Callable[[int], Visibility | None] = unknown_visibility,
    ) -> None:
        """Open the first block; all others have its device, rays per pixel and background.

        Args:
            blocks: the blocks.
            opened: returns a block by its number, from memory or loaded (`few_in_memory`).
            placement: placement of the input in the composed scene.
            scene: the composed scene.
            visibility: returns the visibility network of a block by its number; None for a block without.
        """
        self.blocks, self.opened, self.placement, self.scene = tuple(blocks), opened, placement, scene
        self.visibility = visibility
        first = opened(0).model
        self._device, self._rays_per_pixel, self._background = first.device, first.rays_per_pixel, first.background
        self._centers = torch.tensor([block.center for block in self.blocks], dtype=torch.float64)
        self._radii = torch.tensor([block.radius for block in self.blocks], dtype=torch.float64)

    @property
    def device(self) -> torch.device:
        return self._device

    @property
    def rays_per_pixel(self) -> int:
        return self._rays_per_pixel

    @property
    def background(self) -> Tensor:
        return self._background

    def render_view(self, view: View, background: Tensor) -> Picture:
        shares = self.shares(view, background)
        pictures = [
            recolored(self.picture_of(number, view, background), self.blocks[number].color, background)
            for number in shares
        ]
        return blended(pictures, list(shares.values()))

    def shares(self, view: View, background: Tensor) -> dict[int, float]:
        """Return the share of each block in a picture of `view` over a `background` (3,), by number; they sum to 1."""
        position = self.placement.original_points(view.camera.camera_to_worlds[:, :, 3].cpu())
        shares = near_shares((self._centers - position).norm(dim=-1), self._radii)
        near = _worth_drawing(shares)
        if len(near) > 1:
            coarse = replace(view, stride=view.stride * max(min(view.height, view.width) // LOOK_SIDE, 1))
            visibilities = torch.zeros_like(shares)
            visibilities[near] = torch.tensor(self._visibilities(near, coarse, background), dtype=shares.dtype)
            shares = visible_shares(torch.where(shares >= MIN_SHARE, shares, 0.0), visibilities)
            near = _worth_drawing(shares)
        total = float(shares[near].sum())
        return {number: float(shares[number]) / total for number in near}

    def _visibilities(self, near: list[int], view: View, background: Tensor) -> list[float]:
        """Return how much of a view each of some blocks shows: by their networks if all have one, else by pictures."""
        networks = [network for number in near if (network := self.visibility(number)) is not None]
        if len(networks) < len(near):
            return [float(self.picture_of(number, view, background).accumulation.mean()) for number in near]
        points, directions = points_in_view(view, self.placement, float(self._radii[near].mean()))
        return [float(network.of(points, directions).mean()) for network in networks]

    def picture_of(self, number: int, view: View, background: Tensor) -> Picture:
        """Return the picture of a `view` over a `background` (3,) by the block with a `number`.

        Colours are the block's own, and lengths are in units of the composed scene.

        Colours are the block's own, and lengths are in units of the composed scene.
        """
        model, placement = self.opened(number)
        rotation, scale, shift = self.placement.similarity_to(placement)
        given = moved_cameras(view.camera, rotation, scale, shift)
        camera = refined_cameras(model, given, training=False)  # where the block's own cameras have drifted to
        picture = model.render_view(replace(view, camera=camera, image=None), background)
        depths = picture.depth / scale, picture.median_depth / scale
        return Picture(picture.rgb, *depths, picture.accumulation, num_rays=picture.num_rays)


class GaussianBlocks(Blocks):
    """Blocks that consist of Gaussians, which can be merged into one scene."""

    def gaussians(self, time: float | None = None) -> Gaussians:
        """Return the Gaussians of all blocks at a `time`, in the composed scene, on the CPU (`merge.merged`)."""
        parts = [self._of_block(number, time) for number in range(len(self.blocks))]
        return merged(parts, self.placement.points(self._centers))

    def gaussian_parts(self, time: float | None = None) -> Iterator[Gaussians]:
        """Yield the Gaussians that `gaussians` returns at a `time`, block by block, with few blocks in memory."""
        centers = self.placement.points(self._centers)
        for number in range(len(self.blocks)):
            yield of_cell(self._of_block(number, time), centers, number)

    def _of_block(self, number: int, time: float | None) -> Gaussians:
        """Return all Gaussians of a block in the composed scene, in the matched colours, on the CPU."""
        model, placement = self.opened(number)
        assert isinstance(model, HasGaussians)
        own = model.gaussians(time).map(lambda values: values.detach().cpu())
        own = transformed(own, *placement.similarity_to(self.placement))
        return recolored_gaussians(own, self.blocks[number].color)

    def look(self) -> Look:
        """Return the settings of drawing, from the first block."""
        first = self.opened(0).model
        assert isinstance(first, HasGaussians)
        return first.look()


def few_in_memory(opened: Callable[[int], Opened], kept: int = KEPT) -> Callable[[int], Opened]:
    """Return a function that loads blocks as `opened` does, and keeps some of them in memory.

    Args:
        opened: loads a block, given its number.
        kept: maximum number of blocks in memory. The one that was not used for longest leaves before another is loaded.
    """
    held, lock = OrderedDict[int, Opened](), Lock()

    def of(number: int) -> Opened:
        with lock:
            if number in held:
                held.move_to_end(number)
            else:
                while len(held) >= kept:
                    held.popitem(last=False)
                held[number] = opened(number)
            return held[number]

    return of


def _worth_drawing(shares: Tensor) -> list[int]:
    """Return the blocks with a share of at least MIN_SHARE, the largest first."""
    order = shares.argsort(descending=True, stable=True)
    return order[shares[order] >= MIN_SHARE].tolist()
