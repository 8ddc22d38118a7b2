"""Which sampler a method uses: a grid of what is occupied for a scene in a box, proposals for one without end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from framework.config import TrainConfig
from framework.samplers.occupancy import OccupancySampler
from framework.samplers.proposal import ProposalSampler
from framework.scene import Scene
from framework.scene_profile import Decision


@dataclass(frozen=True)
class SamplingConfig(TrainConfig):
    """Settings of a method that can be sampled through an occupancy grid or by proposals."""

    sampler: Literal["auto", "occupancy", "proposal"] = "auto"
    """occupancy: march through the box where it is not empty. proposal: small density fields say where to look, in all
    of space, contracted. auto: proposal where there may be something outside the box."""
    grid_resolution: int = 128
    """Cells along an axis of the occupancy grid."""
    num_steps: int | None = 512
    """Steps along the box's diagonal, with the occupancy grid."""
    early_stop: float = 1e-4
    """Transmittance below which the rest of a ray is dropped: the largest error of a colour channel (occupancy)."""
    train_early_stop: float = 1e-2
    """The same while training, where less exact colours teach as well."""
    num_proposal_samples: tuple[int, ...] = (128, 64)
    """Intervals a ray of each proposal."""
    num_nerf_samples: int = 32
    """Samples a ray where the proposals say."""


def by_proposals(config: SamplingConfig, scene: Scene) -> bool:
    """Whether proposals are used rather than an occupancy grid; the field is then contracted if there is an outside."""
    return config.sampler == "proposal" or (config.sampler == "auto" and scene.unbounded)


def make_sampler(config: SamplingConfig, scene: Scene) -> OccupancySampler | ProposalSampler:
    """The sampler that the settings and the scene ask for."""
    if by_proposals(config, scene):
        counts = (*config.num_proposal_samples, config.num_nerf_samples)
        resolutions = tuple(128 << level for level in range(len(config.num_proposal_samples)))
        return ProposalSampler(scene.box, counts, resolutions, scene.unbounded, scene.unbounded and not scene.has_alpha)
    assert config.num_steps is not None
    return OccupancySampler(
        scene.box,
        config.grid_resolution,
        config.num_steps,
        config.early_stop,
        config.train_early_stop,
        moving=scene.moving,
    )


def sampler_decisions(config: SamplingConfig, scene: Scene) -> list[Decision]:
    """What became of `--sampler auto`."""
    if config.sampler != "auto":
        return []
    if scene.unbounded:
        return [Decision("sampler", "proposals in contracted space", "there may be something outside the box")]
    return [Decision("sampler", "occupancy grid", "the scene ends at its box")]
