"""NeRF as published in 2020: one large network on frequency encodings, coarse and fine sampling.

Mildenhall et al., "NeRF: Representing Scenes as Neural Radiance Fields for View Synthesis", ECCV 2020. With
`--sampler occupancy` one network of the same shape is sampled through an occupancy grid instead: empty and hidden
space is skipped (as in NerfAcc, Li et al. 2023).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from torch import Tensor

from framework import Decision, Method, Model, Rays, Rendered, Scene
from framework.base.config import Range
from framework.fields.nerf import NeRFField
from framework.kernels.frequency import MAX_FREQUENCIES
from framework.rendering.volume import render_field, render_hierarchical
from framework.samplers.choice import (
    HierarchicalConfig,
    chosen_sampler,
    contracted_box,
    make_sampler,
    sampler_decisions,
)
from framework.samplers.occupancy import OccupancySampler

OCCUPANCY_SAMPLES_PER_BATCH = 2**12
"""With the occupancy grid the number of samples a ray varies a hundredfold, so the number of rays follows it."""
OCCUPANCY_RATE = 2.0
"""Times the learning rate with the occupancy grid. Smaller batches and longer steps (`num_steps`) at twice the rate
reached 22.5 dB on Lego after 90 s on two cores, where 2^13 samples, 512 steps and the paper's rate were at 17."""


@dataclass(frozen=True)
class VanillaNeRFConfig(HierarchicalConfig):
    """Settings of vanilla-nerf; the defaults are the paper's."""

    RANGES: ClassVar[dict[str, Range]] = {
        "num_layers": (3, 64),
        "hidden_width": (2, 2**14),
        "position_frequencies": (0, MAX_FREQUENCIES),
        "direction_frequencies": (0, MAX_FREQUENCIES),
    }
    """What these numbers may be."""
    max_num_iterations: int = 200_000
    num_rays_per_batch: int = 4_096
    learning_rate: float = 5e-4
    lr_final: float = 0.1
    adam_eps: float = 1e-7
    background: Literal["auto", "random", "white", "black"] = "white"
    num_layers: int = 8
    """Layers before density."""
    hidden_width: int = 256
    """Features of a layer."""
    position_frequencies: int = 10
    """L of the position's encoding."""
    direction_frequencies: int = 4
    """L of the direction's encoding."""
    num_steps: int | None = 192
    """Steps along the box's diagonal with the occupancy grid."""


class VanillaNeRF(Model[VanillaNeRFConfig]):
    """Two networks trained together (equations 5 and 6), or one with an occupancy grid or proposals."""

    runs_on_kernels = True

    def __init__(self, config: VanillaNeRFConfig, scene: Scene) -> None:
        super().__init__(config, scene)
        self.contracted_box = contracted_box(config, scene)
        hierarchical = chosen_sampler(config, scene) == "hierarchical"
        self.fine = self._field()
        self.coarse = self._field() if hierarchical else None
        self.sampler = None if hierarchical else make_sampler(config, scene)

    def _field(self) -> NeRFField:
        c = self.config
        return NeRFField(
            c.hidden_width,
            c.num_layers,
            skip=c.num_layers // 2 + 1,
            position_frequencies=c.position_frequencies,
            direction_frequencies=c.direction_frequencies,
            contracted=self.contracted_box,
        )

    def decisions(self) -> list[Decision]:
        return sampler_decisions(self.config, self.scene)

    def render(self, rays: Rays, background: Tensor) -> Rendered:
        if self.sampler is not None:
            return render_field(self.fine, self.sampler, rays, background, self.training)
        assert self.coarse is not None
        counts = self.config.num_coarse_samples, self.config.num_fine_samples
        return render_hierarchical(self.coarse, self.fine, rays, background, counts, self.training)

    def param_groups(self) -> list[dict[str, Any]]:
        faster = OCCUPANCY_RATE if isinstance(self.sampler, OccupancySampler) else 1.0
        fields = [p for field in (self.fine, self.coarse) if field is not None for p in field.parameters()]
        return [
            {"params": fields, "lr": self.config.learning_rate * faster, "name": "networks"},
            *self.proposal_groups(),
        ]

    @property
    def samples_per_batch(self) -> int | None:
        if isinstance(self.sampler, OccupancySampler) and self.config.samples_per_batch is None:
            return OCCUPANCY_SAMPLES_PER_BATCH
        return self.config.samples_per_batch

    def before_step(self, step: int, progress: float) -> None:
        if self.sampler is not None:
            self.sampler.update(step, self.fine.density)


METHOD = Method(VanillaNeRF, VanillaNeRFConfig(), paper="arXiv:2003.08934")
