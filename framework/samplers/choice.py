"""Choice of a method's sampler: occupancy grid or proposals."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, TypeVar

from torch import Tensor

from nerfloom.base.config import AUTO, Auto, Range, RayConfig
from nerfloom.base.decisions import Choice, Decision, fill
from nerfloom.base.device import device_kind, relative_speed
from nerfloom.base.errors import ConfigError
from nerfloom.data.scene import Scene
from nerfloom.encodings.planes import FeaturePlanes
from nerfloom.fields.base import Field
from nerfloom.fields.encoded import DensityField
from nerfloom.geometry.bounds import half_edge
from nerfloom.samplers.base import Sampler
from nerfloom.samplers.hierarchical import MIN_COARSE, HierarchicalSampler
from nerfloom.samplers.motion import vertices_in_time
from nerfloom.samplers.occupancy import MAX_CELLS, MAX_LEVELS, OccupancySampler
from nerfloom.samplers.proposal import LEARN_EVERY, ProposalSampler

NESTED_CELLS = 64
"""Cells along each axis of each nested box, a multiple of 4; 128 in Instant-NGP."""
COARSEST_PROPOSAL = 128
"""Cells along an axis at the finest level of the first proposal; each further proposal has twice as many."""
PROPOSAL_SAMPLES, NERF_SAMPLES = (128, 64), 32
"""Default intervals per ray of each proposal, and samples per ray; fewer if the training time is short."""
MIN_SAMPLES_SECONDS, MIN_SAMPLES = 150.0, 12
"""Up to this training time, in seconds on two CPU threads, `samples_choices` uses the fewest samples per ray."""
MAX_PROPOSALS = 8
"""Maximum number of proposals."""
COARSEST_MOVING, MOVING_FEATURES = 64, 8
"""Spatial vertices per axis of the first proposal of a moving scene (each further proposal has twice as many), and
features per vertex. The values are K-Planes', which has planes in space and time as proposals."""


@dataclass(frozen=True)
class SamplingConfig(RayConfig):
    """Settings of a method that can be sampled with an occupancy grid or with proposals."""

    RANGES: ClassVar[dict[str, Range]] = {
        "grid_resolution": (1, MAX_CELLS),
        "grid_levels": (1, MAX_LEVELS),
        "cone_angle": (0, 1),
        "num_steps": (1, 2**20),
        "eval_step_scale": (0.01, 100),
        "early_stop": (0, 1),
        "train_early_stop": (0, 1),
        "num_proposal_samples": (1, 2**14),
        "num_nerf_samples": (1, 2**14),
    }
    GONE: ClassVar[dict[str, Any]] = {"silhouette_pixels": True, "nested_resolution": NESTED_CELLS}
    sampler: Auto[Literal["occupancy", "proposal"]] = AUTO
    """occupancy: march through the occupied cells of the box, or of nested boxes if the scene may extend beyond the
    box. proposal: small density fields choose the samples. auto: proposal if the scene may extend beyond the box,
    otherwise occupancy. For scenes that may extend beyond the box, both sample all of space, contracted."""
    silhouette_cells: bool = True
    """Never sample cells of the occupancy grid that an image's alpha channel shows to be empty, and never draw pixels
    if their ray passes only through such cells (occupancy)."""
    grid_resolution: int = 128
    """Cells along each axis of the occupancy grid (occupancy, in a box)."""
    grid_levels: int = 8
    """Maximum number of nested boxes, each twice as large as the one before; fewer if these reach the far end of the
    scene (occupancy, beyond the box)."""
    cone_angle: float = 1 / 64
    """Growth of a step per unit of distance from the camera. The default is about one cell of the nested boxes; 1/256
    in the paper (occupancy, beyond the box)."""
    seen_cells: bool = True
    """Never sample cells of nested boxes that no training image shows, or that images show only from closer than their
    known points (occupancy, beyond the box)."""
    num_steps: Auto[int] = 512
    """Steps along the diagonal of the box (occupancy)."""
    eval_step_scale: Auto[float] = 1.0
    """Length of a step in rendering, relative to a training step (occupancy)."""
    early_stop: float = 1e-4
    """Transmittance below which the rest of a ray is dropped: the maximum error of a colour channel (occupancy)."""
    train_early_stop: float = 1e-2
    """The same threshold during training, where less exact colours suffice (occupancy)."""
    num_proposal_samples: Auto[tuple[int, ...]] = PROPOSAL_SAMPLES
    """Intervals per ray of each proposal (proposal)."""
    num_nerf_samples: Auto[int] = NERF_SAMPLES
    """Samples per ray, placed by the last proposal (proposal)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.num_proposal_samples is not None and not 1 <= len(self.num_proposal_samples) <= MAX_PROPOSALS:
            raise ConfigError(f"--num-proposal-samples takes 1 to {MAX_PROPOSALS} numbers, such as 128 64")


@dataclass(frozen=True)
class HierarchicalConfig(SamplingConfig):
    """Settings of a method that can also be sampled hierarchically, with a coarse and a fine field, as in NeRF."""

    RANGES: ClassVar[dict[str, Range]] = {"num_coarse_samples": (MIN_COARSE, 2**14), "num_fine_samples": (1, 2**14)}
    sampler: Auto[Literal["hierarchical", "occupancy", "proposal"]] = AUTO  # type: ignore[assignment]
    """hierarchical: a coarse and a fine field. occupancy: one field and an occupancy grid. proposal: one field, and
    small density fields that choose the samples in all of space, contracted. auto: proposal if the scene may extend
    beyond the box, otherwise hierarchical."""
    num_coarse_samples: int = 64
    """Stratified samples per ray for the coarse field (hierarchical)."""
    num_fine_samples: int = 128
    """Further samples per ray for the fine field, drawn from the coarse field's weights (hierarchical)."""
    bounded_sampler = "hierarchical"


SamplingConfigT = TypeVar("SamplingConfigT", bound=SamplingConfig)


def sampler_choice(config: SamplingConfig, unbounded: bool) -> Choice:
    """Return the sampler that `--sampler auto` selects for a scene that may be `unbounded`."""
    reason = "there may be something outside the box" if unbounded else "the scene ends at its box"
    return Choice("sampler", "proposal" if unbounded else config.bounded_sampler, reason)


def decide_sampler(config: SamplingConfigT, scene: Scene) -> tuple[SamplingConfigT, list[Decision]]:
    """Decide `--sampler auto` from the scene: `Method.decide` of a method with no other open setting.

    Returns:
        the settings, and the decisions made.
    """
    return fill(config, sampler_choice(config, scene.unbounded))


def decide_samples(config: SamplingConfigT, count: int) -> tuple[SamplingConfigT, list[Decision]]:
    """Decide the number of samples per training step with an occupancy grid; other samplers use a number of rays.

    Args:
        config: the method's settings, with the sampler decided.
        count: the method's default number of samples.

    Returns:
        the settings, and the decision, if one was made.
    """
    if config.sampler != "occupancy":
        return config, []
    reason = "the number of samples on a ray varies a hundredfold"
    return fill(config, Choice("samples_per_batch", count, reason, "samples a step"))


def samples_choices(config: SamplingConfig, unlimited: tuple[int, ...] = PROPOSAL_SAMPLES) -> tuple[Choice, Choice]:
    """Return intervals of two proposals and samples per ray that suit the training time on a CPU.

    Fewer samples per ray allow more rays in the same time. A cup reached 28.3, 28.9, 29.3 and 29.5 dB after 100 s with
    32, 24, 16 and 12 samples. After 600 s fern had 26.6 dB with 16 samples and 26.9 dB with 32, in half as many steps
    (docs/notes/captures.md). So there are 12 samples up to 150 s on two threads. Beyond, they grow with the square root
    of time, to 24 at 600 s and at most 32.

    Args:
        config: the method's settings; training time and machine are used.
        unlimited: intervals of each proposal without a time limit.
    """
    seconds, proposals, count, suits = _seconds(config), unlimited, NERF_SAMPLES, "there is time for it"
    if seconds < math.inf:
        count = min(4 * round(MIN_SAMPLES / 4 * max(seconds / MIN_SAMPLES_SECONDS, 1.0) ** 0.5), NERF_SAMPLES)
        proposals, suits = (4 * count - 16, 2 * count - 8), "that suits the time"
    return (
        Choice("num_proposal_samples", proposals, suits, "samples of proposals", " and ".join(map(str, proposals))),
        Choice("num_nerf_samples", count, suits, "samples a ray"),
    )


def batch_choice(config: SamplingConfig, fewest: int, most: int, until: float) -> Choice:
    """Return the samples per training step that suit the training time on a CPU, for feature planes.

    Smaller steps allow more steps, which learn more in a short time; larger steps have less noise
    (docs/notes/learning.md). This was measured with an occupancy grid; with proposals the number is that without a time
    limit.

    Args:
        config: the method's settings, with the sampler decided; training time and machine are used.
        fewest: samples for short times.
        most: maximum number of samples, also used without a time limit.
        until: time in seconds on two threads; in a longer training, samples grow with time.
    """
    seconds = _seconds(config) if config.sampler == "occupancy" else math.inf
    count = most if seconds == math.inf else min(1024 * round(fewest / 1024 * max(seconds / until, 1.0)), most)
    suits = "there is time for it" if seconds == math.inf else "that suits the time"
    return Choice("samples_per_batch", count, suits, "samples a step")


def _seconds(config: SamplingConfig) -> float:
    """Return the training time converted to seconds on two threads; infinity without a limit, or not on a CPU."""
    if config.max_seconds is None or device_kind(config.machine) != "cpu":
        return math.inf
    return config.max_seconds * relative_speed(config.machine)


def contracted_box(config: SamplingConfig, scene: Scene) -> Tensor | None:
    """Return the box (2, 3) of a method's field that contracts all of space around it; None without contraction."""
    return scene.box if scene.unbounded and config.sampler in ("occupancy", "proposal") else None


def make_sampler(
    config: SamplingConfig,
    scene: Scene,
    make_coarse: Callable[[], Field | None] | None = None,
    proposals: Sequence[Field] | None = None,
    learn_every: int = LEARN_EVERY,
    ladder: float | None = None,
    blurs: tuple[float, ...] = (),
) -> Sampler:
    """Return the sampler that the settings select.

    Args:
        make_coarse: creates the coarse field of `--sampler hierarchical`; it returns None if the field is its own
            coarse field. None if the method has no coarse level.
        proposals: density fields of `--sampler proposal`. If None, they are hash grids, or planes in space and time for
            a method that learns motion.
        learn_every: number of steps from one update of the proposals to the next.
        ladder, blurs: as in `ProposalSampler`.

    Raises:
        ConfigError: if the hierarchical sampler is selected and the method has no coarse level.
    """
    sampler: Sampler
    if config.sampler == "proposal":
        count = range(len(config.num_proposal_samples))
        resolutions = tuple(COARSEST_PROPOSAL << level for level in count)
        if proposals is None and scene.moving and config.learns_motion:
            proposals = [_moving_proposal(scene, COARSEST_MOVING << level) for level in count]
        sampler = ProposalSampler(
            scene.box,
            (*config.num_proposal_samples, config.num_nerf_samples),
            resolutions,
            scene.unbounded,
            endless=scene.unbounded and not scene.has_alpha,
            fields=proposals,
            learn_every=learn_every,
            ladder=ladder,
            blurs=blurs,
        )
    elif str(config.sampler) == "hierarchical":
        if make_coarse is None:
            raise ConfigError("--sampler hierarchical: this method has no coarse field")
        sampler = HierarchicalSampler(make_coarse(), config.num_coarse_samples, config.num_fine_samples)
    else:
        levels = _levels(config, scene) if scene.unbounded else 1
        sampler = OccupancySampler(
            scene.box,
            NESTED_CELLS if scene.unbounded else config.grid_resolution,
            config.num_steps,
            config.early_stop,
            config.train_early_stop,
            cone=config.cone_angle if scene.unbounded else 0.0,
            moving=scene.moving,
            levels=levels,
            endless=not scene.has_alpha and scene.unbounded,
            slices=config.time_slices if scene.moving and levels == 1 else 1,
            eval_step_scale=config.eval_step_scale,
        )
    sampler.samples_per_step = config.samples_per_batch
    return sampler


def _moving_proposal(scene: Scene, resolution: int) -> DensityField:
    """Return a density on planes in space and time, with `resolution` vertices per spatial axis."""
    vertices = (resolution,) * 3 + (vertices_in_time(scene),)
    return DensityField(scene.box, FeaturePlanes((vertices,), MOVING_FEATURES), unbounded=scene.unbounded)


def _levels(config: SamplingConfig, scene: Scene) -> int:
    """Return the number of nested boxes that reach the far end, at most the one in `config`."""
    reach = math.log2(max(scene.far / half_edge(scene.box), 1.0))  # infinite where the far end is
    return 1 + math.ceil(min(reach, config.grid_levels - 1))
