"""KiloNeRF: thousands of tiny networks, one for each cell of a grid, distilled from a trained run.

Reiser et al., "KiloNeRF: Speeding up Neural Radiance Fields with Thousands of Tiny MLPs", ICCV 2021. With `--teacher
RUN` the networks first learn the teacher's density and colours at points, and then the photographs; without, they learn
from photographs alone. An occupancy grid skips empty space, so that the networks of empty cells cost nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from nerfloom import Dataset, Decision, Field, Method, RayModel, Renderer, Sampler, Scene
from nerfloom.base.config import AT_LEAST_0, AUTO, Auto, Range
from nerfloom.base.decisions import Choice, fill
from nerfloom.fields.network_grid import NetworkGrid
from nerfloom.kernels.encodings.frequency import MAX_FREQUENCIES
from nerfloom.losses.term import LossTerm, RenderedBatch
from nerfloom.losses.terms import COLOR_ERROR, KNOWN_DISTANCES, SamplerLoss
from nerfloom.renderable import parts
from nerfloom.samplers.base import SkipsCells
from nerfloom.samplers.choice import SamplingConfig, contracted_box, decide_sampler, decide_samples, make_sampler
from nerfloom.training.distillation import MatterPoints, distil, length_in
from nerfloom.training.teacher import Teacher

SAMPLES = 2**15
"""Samples per training step with an occupancy grid."""
PAPER_FREQUENCIES = 10
"""Maximum number of frequencies of positions, unless it is given."""


@dataclass(frozen=True)
class KiloNeRFConfig(
    SamplingConfig,
    max_num_iterations=50_000,
    num_rays_per_batch=8_192,
    learning_rate=1e-2,
    lr_schedule="exponential",
    lr_final=0.05,
    num_steps=384,
    mixed_precision=False,
    teacher_share=0.0,
):
    """Settings of kilo-nerf."""

    RANGES: ClassVar[dict[str, Range]] = {
        "network_resolution": (1, 64),
        "hidden_width": (1, 256),
        "num_layers": (1, 8),
        "position_frequencies": (0, MAX_FREQUENCIES),
        "direction_frequencies": (0, MAX_FREQUENCIES),
        "view_dependence_mult": AT_LEAST_0,
        "distill_steps": (0, 1e7),
        "distill_share": (0, 1),
    }
    network_resolution: int = 8
    """Cells along the longest edge of the box, each with a network of its own."""
    hidden_width: int = 32
    """Features per hidden layer of a network."""
    num_layers: int = 2
    """Hidden layers before density and features; one more is for the colour."""
    position_frequencies: Auto[int] = AUTO
    """Number of frequencies in the encoding of positions in a cell; 10 in the paper. auto: waves of two pixels or
    more, if the images show the box from edge to edge."""
    direction_frequencies: int = 4
    """Number of frequencies in the encoding of directions."""
    view_dependence_mult: float = 1e-6
    """Weight of the size of the layers that know the viewing direction."""
    distill_steps: int = 5_000
    """Steps on points of the teacher's field, before the first step on images (--teacher)."""
    distill_share: float = 0.3
    """Maximum fraction of --max-seconds for these steps (--teacher)."""


class ViewDependence(LossTerm):
    """Length of the parameters of the layers that know the viewing direction: KiloNeRF, section 3.

    Few photographs show a point, and colours between their directions should not be made up. Only networks with samples
    in the step count, because the optimiser updates no others.
    """

    def __call__(self, shown: RenderedBatch) -> Tensor:
        field, samples = shown.model.field, shown.rendered.samples
        assert isinstance(field, NetworkGrid)
        assert samples is not None
        assert samples.features is not None
        return field.color_head.length(field.owners(samples.features))


class KiloNeRF(RayModel[KiloNeRFConfig], plain=True):
    """A model that starts from a teacher's field, if there is a teacher."""

    losses = (COLOR_ERROR, SamplerLoss(), *KNOWN_DISTANCES, ViewDependence("view_dependence", "view_dependence_mult"))

    def __init__(
        self, config: KiloNeRFConfig, scene: Scene, field: Field, sampler: Sampler, renderer: Renderer
    ) -> None:
        super().__init__(config, scene, field, sampler, renderer)
        self.teacher: Teacher | None = None
        """The teacher, until the first step."""

    def take_teacher(self, teacher: Teacher) -> None:
        """Keep a teacher for `start`.

        Args:
            teacher: it must have a field, unless the settings have no steps on points.

        Raises:
            ConfigError: if it has none.
        """
        if self.config.distill_steps:
            teacher.field_model()
            self.teacher = teacher

    def start(self, dataset: Dataset) -> None:
        """Learn the teacher's field, if there is a teacher."""
        if self.teacher is not None:
            box = self.scene.box.to(self.device)
            matter = MatterPoints(self.teacher, box, length_in(box)).around()
            if matter is not None and not self.scene.unbounded:
                self._keep_to(matter)
                box = matter
            seconds = self.config.distill_share * (self.config.max_seconds or math.inf)
            distil(self, self.teacher, dataset, box, self.config.distill_steps, seconds)

    def _keep_to(self, box: Tensor) -> None:
        """Move all networks into a `box` (2, 3) of the scene, and never sample outside of it."""
        assert isinstance(self.field, NetworkGrid)
        self.field.move_to(box)
        for grid in parts(self.sampler, SkipsCells):
            edges = torch.arange(grid.resolution + 1, device=box.device) / grid.resolution
            sides = torch.lerp(grid.box[0], grid.box[1], edges[:, None])  # of the cells, (n + 1, 3)
            x, y, z = ((sides[1:] > box[0]) & (sides[:-1] < box[1])).unbind(-1)
            inside = (x[:, None, None] & y[:, None] & z).flatten()
            grid.carve((~grid.carved.view(grid.slices, -1) & inside).flatten())

    def before_step(self, step: int, progress: float) -> None:
        """Release the teacher, also where a resumed model did not need it, and update the sampler for `step`."""
        self.teacher = None
        super().before_step(step, progress)


def decide(config: KiloNeRFConfig, scene: Scene) -> tuple[KiloNeRFConfig, list[Decision]]:
    """Fill in the settings that depend on the scene."""
    config, made = decide_sampler(config, scene)
    config, samples = decide_samples(config, SAMPLES)
    # Frequency k is 2^k per half of a cell, and a cell has image_size / network_resolution pixels.
    finest = math.log2(math.pi / 2 * scene.image_size / config.network_resolution)
    count = min(max(math.floor(finest) + 1, 1), PAPER_FREQUENCIES)
    reason = "finer waves are shorter than two pixels"
    config, waves = fill(config, Choice("position_frequencies", count, reason, "frequencies of positions"))
    return config, made + samples + waves


def make_field(config: KiloNeRFConfig, scene: Scene) -> NetworkGrid:
    """Return the grid of networks, over the scene's box or over all of space."""
    return NetworkGrid(
        scene.box,
        config.network_resolution,
        config.hidden_width,
        config.num_layers,
        config.position_frequencies,
        config.direction_frequencies,
        unbounded=contracted_box(config, scene) is not None,
    )


METHOD = Method(
    KiloNeRFConfig(),
    paper="arXiv:2103.13744",
    field=make_field,
    sampler=make_sampler,
    model=KiloNeRF,
    decide=decide,
)
