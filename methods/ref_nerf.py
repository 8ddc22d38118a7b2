"""Ref-NeRF: colours from reflected directions, roughness and predicted normals, for shiny surfaces.

Verbin et al., "Ref-NeRF: Structured View-Dependent Appearance for Neural Radiance Fields", CVPR 2022. By default its
networks are small and take features of a hash grid (Mueller et al. 2022); two CPU cores train them in minutes.
`--encoding frequency` uses the paper's networks on Mip-NeRF's integrated encoding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from nerfloom import Decision, Field, Method, RayModel, Sampler, Scene
from nerfloom.base.config import AUTO, Auto, Range
from nerfloom.base.decisions import Choice, fill
from nerfloom.encodings.hash_grid import HashGrid, HashGridConfig
from nerfloom.encodings.integrated import IntegratedEncoding
from nerfloom.fields.directional import PredictedNormalsConfig, Reflection
from nerfloom.fields.encoded import EncodedField
from nerfloom.fields.reflective import ReflectiveNetworks, SkippingNetwork
from nerfloom.kernels.encodings.frequency import MAX_FREQUENCIES
from nerfloom.kernels.encodings.integrated_directional import MAX_BANDS
from nerfloom.losses.normals import PREDICTED_NORMALS
from nerfloom.losses.terms import COLOR_ERROR, KNOWN_DISTANCES, CoarseColorError, SamplerLoss
from nerfloom.methods._grids import finest_cells
from nerfloom.samplers.choice import HierarchicalConfig, contracted_box, decide_samples, make_sampler

SAMPLES = {"hash-grid": 2**15, "frequency": 2**12}
"""Samples per training step with an occupancy grid."""
DEPTH, DIRECTIONAL_SKIP = 8, 5
"""Hidden layers of each of the paper's networks, and of the directional one before its input is repeated."""


@dataclass(frozen=True)
class RefNeRFConfig(
    HashGridConfig,
    HierarchicalConfig,
    PredictedNormalsConfig,
    max_num_iterations=250_000,
    num_rays_per_batch=4_096,
    rays_per_pixel=4,
    train_rays_per_pixel_from=0.75,
    learning_rate=AUTO,
    lr_schedule="hold-exponential",
    lr_final=0.02,
    adam_beta2=0.99,
    adam_eps=1e-15,
    background="white",
    log2_table_size=17,
    num_coarse_samples=128,
    num_fine_samples=128,
    eval_num_rays_per_chunk=8_192,
    thin_gradients=0.5,
):
    """Settings of ref-nerf."""

    RANGES: ClassVar[dict[str, Range]] = {
        "hidden_width": (2, 2**14),
        "bottleneck_width": (1, 2**12),
        "direction_bands": (1, MAX_BANDS),
        "position_frequencies": (1, MAX_FREQUENCIES),
        "open_levels_until": (0, 1),
    }
    encoding: Literal["hash-grid", "frequency"] = "hash-grid"
    """hash-grid: small networks on a hash grid. frequency: the paper's networks of 8 layers, for GPUs."""
    max_resolution: Auto[int] = AUTO
    """Cells per axis at the finest level. auto: a power of two, at least 1 cell per pixel of the images (hash-grid)."""
    learning_rate: Auto[float] = AUTO
    """Initial learning rate of Adam. auto: 0.01 on a hash grid, 0.0005 for the paper's networks."""
    hidden_width: Auto[int] = AUTO
    """Features per hidden layer. auto: 64 on a hash grid, 256 for the paper's networks."""
    bottleneck_width: Auto[int] = AUTO
    """Features that the directional network takes in addition to directions. auto: 16 on a hash grid, 128 otherwise."""
    direction_bands: int = MAX_BANDS
    """Bands of the directional encoding, of degrees 1, 2, 4, 8 and 16."""
    position_frequencies: int = 16
    """Number of frequencies in the integrated encoding of positions (frequency)."""
    open_levels_until: float = 0.3
    """Fraction of the budget until all levels of the hash grid are open, from coarse to fine (hash-grid)."""
    normal_loss_mult: Auto[float] = AUTO
    """Weight of the difference between predicted normals and the density's normals. auto: 0.003 on a hash grid, 0.0003
    for the paper's networks."""
    directional = "reflected"  # no flag


class RefNeRF(RayModel[RefNeRFConfig], plain=True):
    """A model with penalties on predicted normals; a coarse level has a weight of a tenth."""

    losses = (
        COLOR_ERROR,
        CoarseColorError(0.1),
        SamplerLoss(),
        *KNOWN_DISTANCES,
        PREDICTED_NORMALS,
    )


def decide(config: RefNeRFConfig, scene: Scene) -> tuple[RefNeRFConfig, list[Decision]]:
    """Fill in the settings that depend on the encoding and the scene."""
    on_grid = config.encoding == "hash-grid"
    reason = "there may be something outside the box" if scene.unbounded else f"--encoding is {config.encoding}"
    bounded = "occupancy" if on_grid else "hierarchical"
    config, made = fill(config, Choice("sampler", "proposal" if scene.unbounded else bounded, reason))
    config, samples = decide_samples(config, SAMPLES[config.encoding])
    config, _ = fill(
        config,
        Choice("learning_rate", 1e-2 if on_grid else 5e-4, reason),
        Choice("hidden_width", 64 if on_grid else 256, reason),
        Choice("bottleneck_width", 16 if on_grid else 128, reason),
        Choice("normal_loss_mult", 3e-3 if on_grid else 3e-4, reason),
    )
    config, cells = fill(config, finest_cells(scene))
    return config, made + samples + (cells if on_grid else [])


def make_field(config: RefNeRFConfig, scene: Scene) -> Field:
    """Return a field on a hash grid, or the paper's networks."""
    width, bottleneck, bands = config.hidden_width, config.bottleneck_width, config.direction_bands
    unbounded = contracted_box(config, scene) is not None
    if config.encoding == "hash-grid":
        grid, reflection = HashGrid.of(config, config.open_levels_until), Reflection.small(width, bottleneck, bands)
        return EncodedField(scene.box, grid, width, unbounded=unbounded, reflection=reflection)
    encoding = IntegratedEncoding.of_images(scene, config.position_frequencies, unbounded)
    inputs = Reflection.num_inputs(bottleneck, bands)
    directional = SkippingNetwork(inputs, width, DEPTH, DIRECTIONAL_SKIP, 3, "sigmoid")
    return ReflectiveNetworks(encoding, Reflection(directional, bottleneck, bands), width, DEPTH)


def sampler(config: RefNeRFConfig, scene: Scene) -> Sampler:
    """Return the configured sampler; the coarse level of hierarchical sampling is the field itself."""
    return make_sampler(config, scene, make_coarse=lambda: None)


METHOD = Method(
    RefNeRFConfig(),
    paper="arXiv:2112.03907",
    field=make_field,
    sampler=sampler,
    model=RefNeRF,
    decide=decide,
)
