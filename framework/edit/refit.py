"""Refitting: the Gaussians that are kept learn to look like all of them did, from the cameras of the photographs.

They learn from pictures of the Gaussians before, and not from the photographs. So nothing that has been cropped away
comes back, and colours keep the appearance that they have.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from nerfloom.base.console import track
from nerfloom.edit.edited import Edited
from nerfloom.edit.sightings import training_views
from nerfloom.kernels.images.ssim import photometric_loss
from nerfloom.kernels.splats.project import Record, SplatCamera
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.placed_files import in_input
from nerfloom.splats.rasteriser import RASTERISER
from nerfloom.splats.start import scene_size

MAX_VIEWS = 48
"""Maximum number of cameras, evenly spaced; a picture for each stays in memory."""
SSIM_WEIGHT = 0.2
"""Weight of 1 - SSIM in the loss, as in 3DGS."""
RATES = {
    "means": 8e-5,  # sizes of the scene
    "log_scales": 5e-3,
    "rotations": 1e-3,
    "logits": 5e-2,
    "colors": 2.5e-3,
    "harmonics": 1.25e-4,
}
"""Learning rate of each column, as in 3DGS."""
LAST_RATE = 0.1
"""Learning rates after the last step, relative to those at the first. They fall exponentially."""


def refitted(fewer: Edited, before: Edited, steps: int) -> Edited:
    """Return Gaussians that have learnt to look like others. The same ones are returned each time.

    Args:
        fewer: the Gaussians that learn.
        before: the Gaussians that they shall look like, in the same frame, with photographs.
        steps: number of steps, each with a picture from the camera of a training image.

    Raises:
        ConfigError: if photographs are not known, or Gaussians cannot be drawn for their cameras.
    """
    loaded = before.photographed("refit_steps")
    pictures = _Pictures(before.in_scene(), training_views(loaded, before.look, MAX_VIEWS))
    start = fewer.in_scene()
    learnt = start.map(lambda values: values.detach().clone(memory_format=torch.contiguous_format).requires_grad_())
    units = {"means": scene_size(loaded.model.scene, start.means)}
    rates = {name: rate * units.get(name, 1.0) for name, rate in RATES.items() if learnt.columns[name].numel()}
    groups: list[dict[str, Any]] = [
        {"params": [learnt.columns[name]], "lr": rate, "first": rate} for name, rate in rates.items()
    ]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-15)
    random, order = torch.Generator().manual_seed(0), list[int]()
    for step in track(range(steps), "Refitting", total=steps):
        order = order or torch.randperm(len(pictures.views), generator=random).tolist()
        # A random background shows where light passes through.
        background = torch.rand(3, generator=random).to(start.means)
        loss = _loss(learnt, pictures, order.pop(), background)
        if loss is None or not bool(loss.isfinite()):
            continue
        for group in optimizer.param_groups:
            group["lr"] = group["first"] * LAST_RATE ** (step / steps)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    found = learnt.map(Tensor.detach)
    return replace(fewer, gaussians=in_input(found[found.drawable()].map(Tensor.cpu), fewer.placement))


class _Pictures:
    """Pictures of `gaussians` from cameras `views`; each is drawn when it is first needed."""

    def __init__(self, gaussians: Gaussians, views: list[SplatCamera]) -> None:
        self.gaussians, self.views = gaussians, views
        self._drawn: dict[int, tuple[Tensor, Tensor]] = {}

    @torch.no_grad()
    def over(self, index: int, background: Tensor) -> Tensor:
        """Return the picture (H, W, 3) of the camera `index` over a `background` (3,)."""
        if index not in self._drawn:
            camera = self.views[index]
            shown = RASTERISER.project(self.gaussians, camera)
            blended = RASTERISER.draw(shown, camera, torch.zeros_like(background))
            self._drawn[index] = blended.image.half(), blended.transmittance.half()
        light, through = self._drawn[index]
        return light.float() + through.float()[..., None] * background


def _loss(learnt: Gaussians, pictures: _Pictures, index: int, background: Tensor) -> Tensor | None:
    """Return the error of the picture `index`; None if it shows none of the Gaussians."""
    camera = pictures.views[index]
    shown = RASTERISER.project(learnt, camera)
    if not bool((shown.records[:, Record.CUT] > 0).any()):
        return None
    image = RASTERISER.draw(shown, camera, background).image
    return photometric_loss(image, pictures.over(index, background), SSIM_WEIGHT)
