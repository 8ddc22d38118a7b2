"""D-NeRF: a canonical radiance field and a network that deforms it over time; T-NeRF is an option.

Pumarola et al., "D-NeRF: Neural Radiance Fields for Dynamic Scenes", CVPR 2021.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Literal

from nerfloom import Decision, Field, LearnsMotion, Method, RayModel, Sampler, Scene
from nerfloom.base.config import AT_LEAST_0, AUTO, Auto, Range
from nerfloom.base.decisions import Choice, fill
from nerfloom.base.optimised import Optimised
from nerfloom.encodings.hash_grid import HashGrid
from nerfloom.fields.deformed import DeformedField
from nerfloom.fields.encoded import EncodedField
from nerfloom.fields.nerf import NeRFField, NetworkConfig
from nerfloom.kernels.encodings.frequency import MAX_FREQUENCIES
from nerfloom.kernels.grids.hash_grid_layout import MAX_LOG2_TABLE_SIZE, MAX_RESOLUTION
from nerfloom.methods.vanilla_nerf import OCCUPANCY_RATE, OCCUPANCY_SAMPLES_PER_BATCH
from nerfloom.samplers.choice import HierarchicalConfig, contracted_box, decide_samples, make_sampler, sampler_choice
from nerfloom.samplers.motion import MotionConfig, slices_choice

NUM_STEPS, HASH_NUM_STEPS = 192, 384
"""Steps along the diagonal of the box: with networks, and with a hash grid."""
HASH_DEFORMATION = 64, 4, 4
"""Size of the deformation network of a hash grid, as in `deformation_size`."""
HASH_SAMPLES_PER_BATCH = 2**13
"""Samples per training step with an occupancy grid and a hash grid, which needs small networks only."""


@dataclass(frozen=True)
class DNeRFConfig(
    HierarchicalConfig,
    MotionConfig,
    NetworkConfig,
    max_num_iterations=800_000,
    num_rays_per_batch=2_048,
    learning_rate=5e-4,
    lr_schedule=AUTO,
    lr_final=AUTO,
    adam_eps=1e-7,
    num_steps=AUTO,
    eval_step_scale=AUTO,
    thin_gradients=AUTO,
):
    """Settings of dnerf; the defaults of networks, samples and learning rate are the paper's.

    Unlike in the paper, images with alpha are composited over random colours in training. Over white, a model would
    learn white objects as empty space, which stays empty.
    """

    RANGES: ClassVar[dict[str, Range]] = {
        "time_frequencies": (0, MAX_FREQUENCIES),
        "ambient_dims": (0, 2**10),
        "grid_learning_rate": AT_LEAST_0,
        "max_resolution": (1, MAX_RESOLUTION),
        "log2_table_size": (1, MAX_LOG2_TABLE_SIZE),
    }
    GONE: ClassVar[dict[str, Any]] = {
        "deformation_width": lambda config: deformation_size(config)[0],
        "deformation_layers": lambda config: deformation_size(config)[1],
        "deformation_frequencies": lambda config: deformation_size(config)[2],
    }
    variant: Literal["d-nerf", "t-nerf"] = "d-nerf"
    """d-nerf: a canonical field and a deformation network. t-nerf: one network of position and time."""
    canonical: Literal["network", "hash-grid"] = "network"
    """Canonical field of d-nerf: the paper's network, or a hash grid with small networks."""
    num_layers: int = 8
    """Layers of the canonical network before its density output, and hidden layers of the deformation network. A hash
    grid has a smaller deformation network."""
    hidden_width: int = 256
    """Features per layer of the canonical network and of its deformation network."""
    position_frequencies: int = 10
    """Number of frequencies in the encoding of positions, of both networks."""
    time_frequencies: Auto[int] = AUTO
    """Number of frequencies in the encoding of times. auto: 4, or 6 with a hash grid."""
    ambient_dims: Auto[int] = AUTO
    """Further outputs of the deformation network, inputs of a hash grid's networks in addition to the displaced
    position. auto: 4 with a hash grid; otherwise none, as in the paper."""
    grid_learning_rate: float = 1e-2
    """Initial learning rate of the hash grid and of the two networks on it."""
    max_resolution: int = 512
    """Cells per axis at the finest level of the hash grid."""
    log2_table_size: int = 16
    """Maximum number of table entries per level of the hash grid, log2."""
    sparse_updates: bool = True
    """Whether Adam updates only the entries of the hash grid that a step used."""
    grid_resolution: int = 64
    """Cells per axis of the occupancy grid. A cell counts as occupied if it is so at any time of its slice."""
    from_first_image: bool = False
    """Whether nothing is displaced at time 0, as in the paper, so that the canonical field is the scene at that time.
    Otherwise the first image is treated like the others."""


def deformation_size(config: DNeRFConfig) -> tuple[int, int, int]:
    """Return features per layer, hidden layers and frequencies of positions of the deformation network.

    It is as large as the canonical network, as in the paper, or small if the canonical field is a hash grid.
    """
    if config.canonical == "hash-grid":
        return HASH_DEFORMATION
    return config.hidden_width, config.num_layers, config.position_frequencies


class DNeRF(RayModel[DNeRFConfig], LearnsMotion, plain=True):
    """A model of a moving scene; for a scene without times it is the canonical field alone."""

    steps_repeat = True


def decide(config: DNeRFConfig, scene: Scene) -> tuple[DNeRFConfig, list[Decision]]:
    """Fill in the settings that depend on the scene."""
    grid = config.canonical == "hash-grid" and not (scene.moving and config.variant == "t-nerf")
    network = f"the canonical field is a {'hash grid' if grid else 'network'}"
    chosen = sampler_choice(config, scene.unbounded)
    if grid and not scene.unbounded:
        chosen = Choice("sampler", "occupancy", network)
    config, made = fill(
        config,
        chosen,
        Choice("time_frequencies", 6 if grid else 4, network),
        Choice("ambient_dims", 4 if grid else 0, network),
    )
    config, rates = fill(
        config,
        Choice("lr_schedule", "hold-exponential" if grid else "exponential", network, "schedule of the learning rate"),
        Choice("lr_final", 0.02 if grid else 0.1, network, "final learning rate, relative to the initial one"),
    )
    config, slices = fill(config, slices_choice(scene, config.sampler))
    made += rates * grid + slices * (config.time_slices > 1)
    config, steps = fill(
        config,
        Choice("num_steps", HASH_NUM_STEPS if grid else NUM_STEPS, network, "steps along the box's diagonal"),
        Choice("eval_step_scale", 0.5 if grid else 1.0, "edges are sharper", "length of a step in rendering"),
        Choice("thin_gradients", 0.5 if grid else 0.0, network),
    )
    made += steps * (grid and config.sampler == "occupancy")
    if config.sampler == "occupancy":
        samples = HASH_SAMPLES_PER_BATCH if grid else OCCUPANCY_SAMPLES_PER_BATCH
        config, more = decide_samples(config, samples)
        made += more
    if not scene.moving:
        learnt = ("time", "ambient")
        made = [decision for decision in made if not decision.option.startswith(learnt)]
        made.append(Decision("deformation", "left out", "the images have no times"))
    return config, made


def make_field(config: DNeRFConfig, scene: Scene) -> Field:
    """Return a deformed field, one network of position and time, or, if the scene has no times, the canonical field."""
    faster = OCCUPANCY_RATE if config.sampler == "occupancy" else 1.0
    networks = Optimised("networks", learning_rate=config.learning_rate * faster)
    contracted = contracted_box(config, scene)
    if config.canonical == "hash-grid" and not (scene.moving and config.variant == "t-nerf"):
        grid = HashGrid(
            max_resolution=config.max_resolution,
            log2_table_size=config.log2_table_size,
            sparse=config.sparse_updates,
        )
        ambient = config.ambient_dims if scene.moving else 0
        canonical: Field = EncodedField(scene.box, grid, unbounded=contracted is not None, ambient=ambient)
        canonical.optimised = Optimised("heads", learning_rate=config.grid_learning_rate, betas=(0.9, 0.95), eps=1e-15)
    else:
        times = config.time_frequencies if scene.moving and config.variant == "t-nerf" else None
        frequencies = config.position_frequencies, config.direction_frequencies
        skip = config.num_layers // 2 + 1
        canonical = NeRFField(config.hidden_width, config.num_layers, skip, *frequencies, times, contracted)
        canonical.optimised = networks
    if not scene.moving or config.variant == "t-nerf":
        return canonical
    deformed = DeformedField(
        canonical,
        *deformation_size(config),
        config.time_frequencies,
        contracted,
        config.from_first_image,
        config.ambient_dims if config.canonical == "hash-grid" else 0,
    )
    deformed.optimised = networks
    return deformed


def sampler(config: DNeRFConfig, scene: Scene) -> Sampler:
    """Return the configured sampler; the coarse field of hierarchical sampling is built like the fine one."""
    return make_sampler(config, scene, partial(make_field, config, scene))


METHOD = Method(DNeRFConfig(), paper="arXiv:2011.13961", field=make_field, sampler=sampler, model=DNeRF, decide=decide)
