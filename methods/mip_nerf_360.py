"""Mip-NeRF 360: Gaussians in contracted space and an online proposal network, for unbounded scenes.

Barron et al., "Mip-NeRF 360: Unbounded Anti-Aliased Neural Radiance Fields", CVPR 2022. `--encoding integrated` has the
paper's networks, for a GPU. `--encoding hash-grid` applies the same ideas to hash grids (Mueller et al. 2022), for a
CPU: levels have less weight for Gaussians larger than their cells (Zip-NeRF, Barron et al. 2023).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

from torch import Tensor

from nerfloom import Decision, Field, Method, Sampler, Scene
from nerfloom.base.config import AT_LEAST_0, AUTO, Auto, Range
from nerfloom.base.decisions import Choice, fill
from nerfloom.base.device import device_kind
from nerfloom.base.optimised import Optimised
from nerfloom.encodings.integrated import IntegratedEncoding, icosahedron_directions
from nerfloom.encodings.multisampled import MultisampledHashGrid
from nerfloom.fields.integrated import IntegratedDensity, IntegratedField
from nerfloom.fields.nerf import NetworkConfig
from nerfloom.fields.sized import SizedDensity, SizedField
from nerfloom.kernels.encodings.frequency import MAX_FREQUENCIES
from nerfloom.losses.functions import charbonnier
from nerfloom.losses.term import RenderedBatch
from nerfloom.losses.terms import KNOWN_DISTANCES, ColorError, Distortion, SamplerLoss
from nerfloom.methods._captures import (
    MARCHED_SAMPLES,
    PAPER_SAMPLES,
    ProposedConfig,
    RefinedModel,
    refined_sampler_choice,
    refinement_choice,
)
from nerfloom.methods._grids import GRID_WIDTH, GridsConfig, grid_optimiser
from nerfloom.samplers.choice import (
    COARSEST_PROPOSAL,
    contracted_box,
    decide_samples,
    make_sampler,
    samples_choices,
)
from nerfloom.samplers.proposal import LEARN_EVERY

DISTORTION = 0.01
"""Default weight of the distortion loss in unbounded scenes, the paper's."""
MIN_NETWORK_SECONDS = 3600.0
"""Minimum training time on a GPU for the paper's networks as the default, seconds. After 45 s on a data-centre
GPU they reached 20.2 dB on a can, and hash grids 34.8 dB; longer runs were not measured."""
PROPOSAL_LEVELS, PROPOSAL_BASE, PROPOSAL_TABLE = 5, 16, 16
"""Levels of the proposals' hash grids, cells per axis of the first level, and log2 of the entries per level."""


@dataclass(frozen=True)
class MipNeRF360Config(
    GridsConfig,
    ProposedConfig,
    NetworkConfig,
    max_num_iterations=250_000,
    num_rays_per_batch=2_048,
    learning_rate=2e-3,
    lr_final=0.01,
    lr_warmup_steps=128,
    adam_eps=1e-6,
    eval_num_rays_per_chunk=4_096,
    sampler="proposal",
    max_resolution=4_096,
):
    """Settings of mip-nerf-360; the defaults are the paper's, with an eighth of its rays and a quarter of its warm-up.

    Unlike in the paper, gradients are not clipped, and histograms are not dilated before drawing intervals.
    """

    RANGES: ClassVar[dict[str, Range]] = {
        "position_frequencies": (1, MAX_FREQUENCIES),
        "distortion_loss_mult": AT_LEAST_0,
    }
    GONE: ClassVar[dict[str, Any]] = {
        "proposal_width": lambda config: proposal_size(config)[0],
        "proposal_layers": lambda config: proposal_size(config)[1],
    }
    encoding: Auto[Literal["integrated", "hash-grid"]] = AUTO
    """integrated: the paper's networks. hash-grid: hash grids with small networks. auto: hash-grid on a CPU."""
    distortion_loss_mult: Auto[float] = AUTO
    """Weight of the distortion loss. auto: 0.01 in unbounded scenes, otherwise 0."""
    num_layers: int = 8
    """Layers of the network before its density output. The proposal network has half of them (integrated)."""
    hidden_width: int = 1_024
    """Features per layer of the network. The proposal network has a quarter of them (integrated)."""
    position_frequencies: int = 12
    """Number of frequencies in the integrated encoding of positions (integrated)."""
    direction_frequencies: int = 4
    """Number of frequencies in the encoding of directions (integrated)."""


def proposal_size(config: MipNeRF360Config) -> tuple[int, int]:
    """Return features per layer and hidden layers of the proposal network: 256 and 4 in the paper."""
    return max(config.hidden_width // 4, 1), config.num_layers // 2


class SmoothColorError(ColorError):
    """Smooth absolute error of colours in unbounded scenes (section 5), otherwise the mean squared error.

    In a box, if most of the image is background, an empty scene minimises absolute errors. Training cannot leave that
    state.
    """

    def error(self, rgb: Tensor, shown: RenderedBatch) -> Tensor:
        if not shown.model.scene.unbounded:
            return super().error(rgb, shown)
        return charbonnier(rgb, shown.batch.rgb, shown.batch.weights)


class MipNeRF360(RefinedModel[MipNeRF360Config], plain=True):
    """A model with a smooth absolute colour error and the distortion loss."""

    losses = (SmoothColorError(), SamplerLoss(), *KNOWN_DISTANCES, Distortion(of_marched=False))
    steps_repeat = True


def decide(config: MipNeRF360Config, scene: Scene) -> tuple[MipNeRF360Config, list[Decision]]:
    """Fill in the settings that depend on the scene and on the machine."""
    encoding, reason = "integrated", "a GPU runs the paper's networks"
    if device_kind(config.machine) == "cpu":
        encoding, reason = "hash-grid", "the paper's networks take days on a processor (else: --encoding integrated)"
    elif config.max_seconds is not None and config.max_seconds < MIN_NETWORK_SECONDS:
        encoding, reason = "hash-grid", "the paper's networks take hours on a GPU (else: --encoding integrated)"
    around = "there may be something outside the box" if scene.unbounded else "the scene ends at its box"
    config, made = fill(config, refined_sampler_choice(config, scene.unbounded))
    config, more = fill(
        config,
        Choice("encoding", encoding, reason),
        Choice("distortion_loss_mult", DISTORTION if scene.unbounded else 0.0, around, "distortion loss"),
        refinement_choice(scene, config.sampler != "proposal"),
    )
    config, samples = decide_samples(config, MARCHED_SAMPLES)
    grids = config.encoding == "hash-grid"
    timed = config if grids else replace(config, max_seconds=None)
    config, counts = fill(config, *samples_choices(timed, PAPER_SAMPLES))
    return config, made + more + samples + counts * (grids and config.sampler == "proposal")


def make_field(config: MipNeRF360Config, scene: Scene) -> Field:
    """Return the network on the integrated encoding, or the hash grid with its networks."""
    if config.encoding == "integrated":
        return IntegratedField(
            _encoding(config, scene),
            config.hidden_width,
            config.num_layers,
            skip=config.num_layers // 2 + 1,
            direction_frequencies=config.direction_frequencies,
        )
    unbounded = contracted_box(config, scene) is not None
    field = SizedField(scene.box, MultisampledHashGrid.of(config), GRID_WIDTH, unbounded=unbounded)
    field.optimised = grid_optimiser(config, "grid")
    return field


def make_proposals(config: MipNeRF360Config, scene: Scene) -> Sequence[Field]:
    """Return the density fields of the proposals: one network for all levels, or a hash grid for each."""
    if config.encoding == "integrated":
        network = IntegratedDensity(_encoding(config, scene), *proposal_size(config))
        network.optimised = Optimised(
            "proposals", config.learning_rate, (config.adam_beta1, config.adam_beta2), config.adam_eps
        )
        return [network]
    unbounded = contracted_box(config, scene) is not None
    fields = []
    for level in range(len(config.num_proposal_samples)):
        grid = MultisampledHashGrid(PROPOSAL_LEVELS, 2, PROPOSAL_BASE, COARSEST_PROPOSAL << level, PROPOSAL_TABLE)
        fields.append(SizedDensity(scene.box, grid, unbounded=unbounded))
        fields[-1].optimised = grid_optimiser(config, "proposals")
    return fields


def _encoding(config: MipNeRF360Config, scene: Scene) -> IntegratedEncoding:
    contracted = contracted_box(config, scene) is not None
    return IntegratedEncoding.of_images(scene, config.position_frequencies, contracted, icosahedron_directions())


def sampler(config: MipNeRF360Config, scene: Scene) -> Sampler:
    """Return the configured sampler. A proposal network learns in every step, hash grids less often."""
    learn_every = 1 if config.encoding == "integrated" else LEARN_EVERY
    proposals = make_proposals(config, scene) if config.sampler == "proposal" else None
    return make_sampler(config, scene, proposals=proposals, learn_every=learn_every)


METHOD = Method(
    MipNeRF360Config(), paper="arXiv:2111.12077", field=make_field, sampler=sampler, model=MipNeRF360, decide=decide
)
