"""Which sampler a method uses: a grid of what is occupied for a scene in a box, proposals for one without end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Literal, TypeVar

from torch import Tensor

from framework.base.config import Auto, Range, RayConfig
from framework.base.decisions import Choice, Decision, fill
from framework.base.errors import ConfigError
from framework.data.scene import Scene
from framework.fields.base import Field
from framework.samplers.base import Sampler
from framework.samplers.hierarchical import LEAST_COARSE, HierarchicalSampler
from framework.samplers.occupancy import MAX_CELLS, OccupancySampler
from framework.samplers.proposal import ProposalSampler

COARSEST_PROPOSAL = 128
"""Cells along an axis at the finest level of the first proposal; each further one has twice as many."""
MOST_PROPOSALS = 8


@dataclass(frozen=True)
class SamplingConfig(RayConfig):
    """Settings of a method that can be sampled through an occupancy grid or by proposals."""

    RANGES: ClassVar[dict[str, Range]] = {
        "grid_resolution": (1, MAX_CELLS),
        "num_steps": (1, 2**20),
        "early_stop": (0, 1),
        "train_early_stop": (0, 1),
        "num_proposal_samples": (1, 2**14),
        "num_nerf_samples": (1, 2**14),
    }
    """What these numbers may be."""
    sampler: Literal["auto", "occupancy", "proposal"] = "auto"
    """occupancy: march through the box where it is not empty. proposal: small density fields say where to look, in all
    of space, contracted. auto: proposal where there may be something outside the box."""
    silhouette_cells: bool = True
    """Where images are transparent, cells of the occupancy grid that one of them shows empty are never sampled."""
    silhouette_pixels: bool = True
    """Pixels whose ray meets only such cells are never drawn."""
    grid_resolution: int = 128
    """Cells along an axis of the occupancy grid (occupancy)."""
    num_steps: Auto[int] = 512
    """Steps along the box's diagonal (occupancy)."""
    early_stop: float = 1e-4
    """Transmittance below which the rest of a ray is dropped: the largest error of a colour channel (occupancy)."""
    train_early_stop: float = 1e-2
    """The same while training, where less exact colours teach as well (occupancy)."""
    num_proposal_samples: tuple[int, ...] = (128, 64)
    """Intervals a ray of each proposal (proposal)."""
    num_nerf_samples: int = 32
    """Samples a ray where the proposals say (proposal)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= len(self.num_proposal_samples) <= MOST_PROPOSALS:
            raise ConfigError(f"--num-proposal-samples must name 1 to {MOST_PROPOSALS} proposals, as in 128 64")


@dataclass(frozen=True)
class HierarchicalConfig(SamplingConfig):
    """Settings of a method that can also be sampled as NeRF is, by a coarse field for a fine one."""

    RANGES: ClassVar[dict[str, Range]] = {
        "num_coarse_samples": (LEAST_COARSE, 2**14),
        "num_fine_samples": (1, 2**14),
    }
    """What these numbers may be."""
    sampler: Literal["auto", "hierarchical", "occupancy", "proposal"] = "auto"  # type: ignore[assignment]
    """hierarchical: a coarse and a fine field. occupancy: one field and an occupancy grid. proposal: one field, and
    small density fields that say where to look, in all of space, contracted. auto: hierarchical, or proposal where
    there may be something outside the box."""
    num_coarse_samples: int = 64
    """Stratified samples a ray for the coarse field (hierarchical)."""
    num_fine_samples: int = 128
    """Further samples a ray for the fine field, drawn where the coarse one found something (hierarchical)."""


SamplingConfigT = TypeVar("SamplingConfigT", bound=SamplingConfig)


def sampler_choice(config: SamplingConfig, unbounded: bool) -> Choice:
    """Return what `--sampler auto` becomes.

    Args:
        config: the method's settings.
        unbounded: there may be something outside the box.
    """
    bounded = "hierarchical" if isinstance(config, HierarchicalConfig) else "occupancy"
    reason = "there may be something outside the box" if unbounded else "the scene ends at its box"
    return Choice("sampler", "proposal" if unbounded else bounded, reason)


def decide_sampler(config: SamplingConfigT, scene: Scene) -> tuple[SamplingConfigT, list[Decision]]:
    """Decide `--sampler auto` by the scene: `Method.decide` of a method that leaves nothing else open.

    Args:
        config: the method's settings.
        scene: facts about the data.
    """
    return fill(config, sampler_choice(config, scene.unbounded))


def contracted_box(config: SamplingConfig, scene: Scene) -> Tensor | None:
    """Return the box around which a method's field contracts all of space; None where it ends at its box.

    Args:
        config: the settings, decided.
        scene: facts about the data.
    """
    return scene.box if scene.unbounded and config.sampler == "proposal" else None


def make_sampler(config: SamplingConfig, scene: Scene, make_coarse: Callable[[], Field] | None = None) -> Sampler:
    """Return the sampler that the settings ask for.

    Args:
        config: the settings, decided.
        scene: facts about the data.
        make_coarse: makes the coarse field of `--sampler hierarchical`.
    Raises: ConfigError where that is asked for and the method has no such field.
    """
    sampler = _sampler(config, scene, make_coarse)
    sampler.samples_per_step = config.samples_per_batch
    return sampler


def _sampler(config: SamplingConfig, scene: Scene, make_coarse: Callable[[], Field] | None) -> Sampler:
    if config.sampler == "proposal":
        resolutions = tuple(COARSEST_PROPOSAL << level for level in range(len(config.num_proposal_samples)))
        return ProposalSampler(
            scene.box,
            (*config.num_proposal_samples, config.num_nerf_samples),
            resolutions,
            scene.unbounded,
            endless=scene.unbounded and not scene.has_alpha,
        )
    if isinstance(config, HierarchicalConfig) and str(config.sampler) == "hierarchical":
        if make_coarse is None:
            raise ConfigError("--sampler hierarchical: this method has no coarse field")
        return HierarchicalSampler(make_coarse(), config.num_coarse_samples, config.num_fine_samples)
    return OccupancySampler(
        scene.box,
        config.grid_resolution,
        config.num_steps,
        config.early_stop,
        config.train_early_stop,
        moving=scene.moving,
    )
