"""Search for colours that make blocks match their neighbours, by pictures of the images that they share."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from nerfloom.base.evenly_spaced import evenly_spaced
from nerfloom.blocks.block import TrainedBlock
from nerfloom.blocks.colors import fitted_color, matching_order, recolored
from nerfloom.blocks.composed import Blocks
from nerfloom.cameras.cameras import Cameras
from nerfloom.cameras.view import View
from nerfloom.rendering.light import without_background

MAX_VIEWS = 6
"""Maximum number of shared images that match the colours of two blocks."""
SIDE = 48
"""Minimum length of the longer side of the compared pictures, pixels. It is less than twice this."""


def matched(model: Blocks, cameras: Cameras, times: Tensor | None) -> list[TrainedBlock]:
    """Return the blocks of a model with colours that match their neighbours.

    The block that shares most images keeps its colours; the others follow from neighbour to neighbour.

    Args:
        model: the blocks; their colours so far do not matter.
        cameras: M cameras of all training images, in the composed scene, on the model's device.
        times: (M,) time of each; None for a still scene.
    """
    found = [TrainedBlock(one.center, one.radius, one.cameras, one.run) for one in model.blocks]
    for number, reference in matching_order([block.cameras for block in found]):
        shared = torch.tensor(sorted(set(found[number].cameras) & set(found[reference].cameras)))
        pixels = []
        for index in shared[evenly_spaced(len(shared), MAX_VIEWS)].tolist():
            view, background = _small(View.of(cameras, index, times)), model.background
            wanted = recolored(model.picture_of(reference, view, background), found[reference].color, background)
            seen = model.picture_of(number, view, background)
            both = [without_background(each.rgb, each.accumulation, background) for each in (seen, wanted)]
            pixels.append([each.reshape(-1, 4) for each in both])
        seen_pixels, wanted_pixels = (torch.cat(each).cpu() for each in zip(*pixels, strict=True))
        color = fitted_color(seen_pixels, wanted_pixels[:, :3])
        found[number] = replace(found[number], color=tuple(map(tuple, color.tolist())))
    return found


def _small(view: View) -> View:
    return replace(view, stride=max(max(view.height, view.width) // SIDE, 1))
