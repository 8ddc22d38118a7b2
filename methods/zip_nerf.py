"""Zip-NeRF: a hash grid for cones, with multisampling, features weighted by scale, and anti-aliased proposals.

Barron et al., "Zip-NeRF: Anti-Aliased Grid-Based Neural Radiance Fields", ICCV 2023. Sizes are for a CPU: tables of
2^18 entries and grids of up to 2048 cells per axis, where the paper has 2^21 and 8192. The networks are nerfacto's.
Further differences from the paper:

- A scene that ends at its box is sampled with an occupancy grid.
- Proposals are looked up at one point per interval, and the grid does not decay, unless selected.
- The colour loss is the mean squared error.
- The networks do not get the levels' weights.
- Gradients near cameras are scaled down (Philip and Deschaintre 2023).
- An image's exposure is an affine function of its colours, by default.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

from nerfloom import ConfigError, Decision, Method, Sampler, Scene
from nerfloom.base.config import AT_LEAST_0, Range
from nerfloom.base.decisions import is_open
from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.encodings.multisampled import MultisampledHashGrid
from nerfloom.fields.directional import DensityDirectionalConfig, reflection_of
from nerfloom.fields.encoded import DensityField
from nerfloom.fields.multisampled import MultisampledDensity, MultisampledField
from nerfloom.kernels.grids.hash_grid_layout import MAX_LOG2_TABLE_SIZE, MAX_RESOLUTION
from nerfloom.losses.normals import PREDICTED_NORMALS
from nerfloom.losses.terms import COLOR_ERROR, KNOWN_DISTANCES, Distortion, SamplerLoss
from nerfloom.methods._captures import PAPER_SAMPLES, CaptureConfig, RefinedModel, decide_capture
from nerfloom.samplers.choice import decide_samples, make_sampler

POWER_LADDER = -1.5
"""Exponent of the power ladder that spaces distances if space is contracted, the paper's for all scenes."""
PROPOSAL_LEVELS = 5
"""Number of levels of each proposal's hash grid."""
SAMPLES_PER_BATCH = 2**14
"""Samples per training step with an occupancy grid over a box."""


@dataclass(frozen=True)
class ZipNeRFConfig(
    CaptureConfig,
    DensityDirectionalConfig,
    max_num_iterations=25_000,
    num_steps=256,
    num_levels=8,
    features_per_level=4,
    thin_gradients=0.5,
):
    """Settings of zip-nerf; open ones depend on the scene."""

    RANGES: ClassVar[dict[str, Range]] = {
        "interlevel_blurs": (1e-6, 1),
        "hash_decay_mult": AT_LEAST_0,
        "proposal_resolutions": (1, MAX_RESOLUTION),
        "proposal_log2_table_size": (1, MAX_LOG2_TABLE_SIZE),
        "hidden_width": (1, 2**14),
    }
    GONE: ClassVar[dict[str, Any]] = {"power_ladder": POWER_LADDER, "num_proposal_levels": PROPOSAL_LEVELS}
    changing_light = "affine"
    interlevel_blurs: tuple[float, ...] = (0.03, 0.003)
    """Radius of the box filter on the samples' histogram in each proposal's loss, in normalised distance."""
    hash_decay_mult: float = 0.0
    """Weight of the mean square of each level's features. The paper has 0.1, and 10 for objects, which suits its 25,000
    steps of 65,536 rays and its loss with a larger gradient; in runs of minutes, 0.1 costs 0.6 to 1.4 dB."""
    multisampled_proposals: bool = False
    """Whether proposals are also looked up at several points per interval, in grids of one feature per vertex, as in
    the paper; otherwise at one point, with two features. The paper's grids have up to 512 and 2048 cells per axis."""
    proposal_resolutions: tuple[int, ...] = (128, 256)
    """Cells per axis at the finest level of each proposal's hash grid."""
    proposal_log2_table_size: int = 16
    """Maximum number of table entries per level of the proposals' hash grids, log2."""
    hidden_width: int = 64
    """Features per hidden layer of the two networks."""

    def __post_init__(self) -> None:
        super().__post_init__()
        proposals = PAPER_SAMPLES if is_open(self.num_proposal_samples) else self.num_proposal_samples
        if len({len(proposals), len(self.proposal_resolutions), len(self.interlevel_blurs)}) > 1:
            raise ConfigError(
                "--num-proposal-samples, --proposal-resolutions and --interlevel-blurs need one number a proposal each"
            )


class ZipNeRF(RefinedModel[ZipNeRFConfig], plain=True):
    """A model with refined poses and the distortion loss."""

    losses = (COLOR_ERROR, SamplerLoss(), *KNOWN_DISTANCES, Distortion(), PREDICTED_NORMALS)
    steps_repeat = True


def decide(config: ZipNeRFConfig, scene: Scene) -> tuple[ZipNeRFConfig, list[Decision]]:
    """Return `config` with the settings filled in that depend on the `scene`, and a record of each."""
    config, made = decide_capture(config, scene, PAPER_SAMPLES)
    config, samples = decide_samples(config, SAMPLES_PER_BATCH)
    return config, made + samples


def make_field(config: ZipNeRFConfig, scene: Scene) -> MultisampledField:
    """Return a field of one multisampled hash grid and two small networks, by `config` and `scene`."""
    grid = MultisampledHashGrid.of(config, config.hash_decay_mult)
    reflection = reflection_of(config, config.hidden_width)
    return MultisampledField(scene.box, grid, config.hidden_width, unbounded=config.contraction, reflection=reflection)


def sampler(config: ZipNeRFConfig, scene: Scene) -> Sampler:
    """Return proposals with the anti-aliased loss for `scene`, or the sampler named by `config`."""
    scene = replace(scene, unbounded=config.contraction)

    def proposal(finest: int) -> DensityField:
        features = 1 if config.multisampled_proposals else 2
        sizes = PROPOSAL_LEVELS, features, config.base_resolution, finest, config.proposal_log2_table_size
        if not config.multisampled_proposals:
            return DensityField(scene.box, HashGrid(*sizes), unbounded=scene.unbounded)
        grid = MultisampledHashGrid(*sizes, config.sparse_updates, config.hash_decay_mult)
        return MultisampledDensity(scene.box, grid, unbounded=scene.unbounded)

    proposals = [proposal(finest) for finest in config.proposal_resolutions] if config.sampler == "proposal" else None
    return make_sampler(config, scene, proposals=proposals, ladder=POWER_LADDER, blurs=config.interlevel_blurs)


METHOD = Method(
    ZipNeRFConfig(),
    paper="arXiv:2304.06706",
    field=make_field,
    sampler=sampler,
    model=ZipNeRF,
    decide=decide,
)
