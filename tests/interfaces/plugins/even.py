"""Instant-NGP with the same number of samples on every ray, evenly through the box."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from nerfloom import Field, Rays, Sampler, Samples
from nerfloom.geometry.bounds import intersect_box
from nerfloom.methods import instant_ngp

COUNT = 48


class EvenSampler(Sampler):
    """COUNT samples on every ray where it passes through a box.

    Args:
        box: (2, 3) corners.
    """

    box: Tensor

    def __init__(self, box: Tensor) -> None:
        super().__init__()
        self.register_buffer("box", box.clone())

    def sample(self, rays: Rays, field: Field, jitter: bool) -> Samples:
        enter, leave = intersect_box(rays.origins, rays.directions, self.box)
        near = torch.maximum(enter, rays.nears)
        far = torch.maximum(torch.minimum(leave, rays.fars), near)
        edges = torch.lerp(near[:, None], far[:, None], torch.linspace(0, 1, COUNT + 1, device=near.device))
        within = torch.rand_like(edges[:, 1:]) if jitter else torch.full_like(edges[:, 1:], 0.5)
        return Samples.regular(edges[:, :-1], edges[:, 1:], torch.lerp(edges[:, :-1], edges[:, 1:], within))


METHOD = replace(instant_ngp.METHOD, sampler=lambda config, scene: EvenSampler(scene.box))
