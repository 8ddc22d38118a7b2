"""Instant-NGP: a multiresolution hash grid, two small networks and an occupancy grid.

Mueller et al., "Instant Neural Graphics Primitives with a Multiresolution Hash Encoding", SIGGRAPH 2022. With
`--background-model sphere` a second grid shows the outside of a sphere, as in NeRF++ (Zhang et al. 2020).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

from nerfloom import ConfigError, Decision, Method, Scene
from nerfloom.base.config import AUTO, Auto, Range
from nerfloom.base.decisions import Choice, fill, is_open
from nerfloom.base.device import relative_speed
from nerfloom.encodings.hash_grid import HashGrid, HashGridConfig
from nerfloom.fields.directional import DensityDirectionalConfig, reflection_of
from nerfloom.fields.encoded import EncodedField
from nerfloom.fields.inverted import InvertedField
from nerfloom.losses.few_images import FewImagesConfig, decide_few_images
from nerfloom.losses.normals import PREDICTED_NORMALS
from nerfloom.losses.terms import COLOR_ERROR, FEW_IMAGES, KNOWN_DISTANCES, SamplerLoss
from nerfloom.methods._grids import finest_cells
from nerfloom.ray_model import RayModel
from nerfloom.rendering.background import background_renderer
from nerfloom.samplers.background import BackgroundConfig, decide_background, foreground
from nerfloom.samplers.choice import contracted_box
from nerfloom.samplers.inside import make_foreground_sampler

FITTED_SECONDS, FITTED_PIXELS = 150.0, 400
"""Reference for `plan`: seconds of training on two CPU threads, and pixels of the images' longer side. Its settings
come from trials on Lego, 400 x 400, after 15, 45, 150 and 300 s."""
TABLE_SECONDS, STEPS_SECONDS, LARGE_STEP_SECONDS = 60.0, 110.0, 300.0
"""Training times, in seconds: tables have 2^17 entries, steps along rays start to shorten, and a training step has 2^16
samples. On Lego, 2^17 entries were 0.30 and 0.35 dB better than 2^16 after 45 s (docs/notes/learning.md)."""
MIN_SAMPLES, MAX_SAMPLES = 24 * 2**10, 2**16
"""Samples per step in the shortest and in the longest time."""
HASTE_SECONDS, NO_HASTE_SECONDS, LATE_UNTIL_SECONDS = 15.0, 45.0, 150.0
"""Runs up to the first number of seconds use the fastest settings, and runs beyond the second the usual ones. Training
has one ray per pixel for 90 % of the time up to the second number, and for 75 % from the third on."""

THIN = 0.5
"""Samples below this fraction of the mean gradient are thinned. On Lego, two seeds gave 28.34 and 28.52 dB after 800
steps without thinning, and 28.36 and 28.48 dB with it, in 0.78 of the processor time."""

MIN_SPARSE_TABLE = 17
"""Minimum log2 of the table size for sparse updates. On Lego, three runs of 45 s with 2^16 entries were 0.06,
0.23 and 0.25 dB better with dense updates, which move rarely used entries further. After 300 s with 2^18 entries,
sparse updates were 0.21 dB better."""


@dataclass(frozen=True)
class InstantNGPConfig(
    HashGridConfig,
    BackgroundConfig,
    FewImagesConfig,
    DensityDirectionalConfig,
    max_num_iterations=20_000,
    num_rays_per_batch=8_192,
    rays_per_pixel=4,
    train_rays_per_pixel_from=AUTO,
    learning_rate=AUTO,
    lr_schedule="hold-exponential",
    lr_final=0.05,
    adam_beta2=0.95,
    adam_eps=1e-15,
    num_steps=AUTO,
    eval_step_scale=AUTO,
    eval_num_rays_per_chunk=32_768,
    thin_gradients=AUTO,
):
    """Settings of instant-ngp."""

    RANGES: ClassVar[dict[str, Range]] = {"detail": (1, 64), "hidden_width": (1, 2**14)}
    max_resolution: Auto[int] = AUTO
    """Cells per axis at the finest level. auto: a power of two, at least `detail` cells per pixel."""
    detail: Auto[int] = AUTO
    """Cells of the finest level per pixel of the images' longer side. auto: depends on --max-seconds."""
    log2_table_size: Auto[int] = AUTO
    """Maximum number of table entries per level, log2. auto: depends on --max-seconds."""
    sparse_updates: Auto[bool] = AUTO
    """Whether Adam updates only the table entries that a step used. auto: with 2^17 or more entries per level."""
    hidden_width: int = 64
    """Features per hidden layer of the two networks."""
    view_dependence: bool = True
    """Whether colour depends on the viewing direction. Most scenes need it; False saves a few per cent of time."""


@dataclass(frozen=True)
class Plan:
    """Settings for a given time. Small tables and batches learn fastest; large ones reach a higher PSNR."""

    log2_table_size: int
    """log2 of the number of table entries per level."""
    num_steps: int
    """Marching steps along the box's diagonal."""
    samples: int
    """Samples per training step."""
    detail: int
    """Cells of the finest level per pixel of the images' longer side."""
    learning_rate: float
    """Initial learning rate of Adam."""
    several_rays_from: float
    """Fraction of the time before training uses several rays per pixel."""
    thin: float
    """Samples below this fraction of the mean gradient are thinned."""
    eval_step_scale: float
    """Length of a step in rendering, relative to a training step."""


def plan(seconds: float, image_size: int, speed: float = 1.0) -> Plan:
    """Return the settings that suit a training time and an image size.

    Table sizes are proportional to the time, with 2^17 entries at 60 s on two threads, between 2^16 and 2^18. The steps
    along the diagonal and the cells per pixel also grow: 512 and 1 at 45 s, 704 and 2 at 150 s, at most 1,024 and 2.
    The samples per step grow with the square root of time, from 24,576 to 2^16 at 300 s. Images larger than 400 pixels,
    up to twice as large, have more detail. Their tables grow up to 2^19 entries at 600 s, and they get 2 cells per
    pixel correspondingly later.

    Runs below 45 s use larger and coarser steps: up to 15 s, twice the learning rate, twice the thinning, and 384 steps
    along the diagonal (halved in length for rendering). Training uses several rays per pixel after 90 % of the time in
    runs up to 45 s, and after 75 % from 150 s on.

    Args:
        seconds: maximum training time, seconds; infinity without a limit.
        image_size: longer side of the largest image, pixels.
        speed: speed of this machine, relative to two threads of a CPU.
    """
    time, size = seconds * speed / FITTED_SECONDS, min(max(image_size / FITTED_PIXELS, 1.0), 2.0)
    longer = min(max(seconds * speed / STEPS_SECONDS, 1.0), 2.0)
    share = (seconds * speed / LARGE_STEP_SECONDS) ** 0.5  # of the maximum samples
    haste = way_between(seconds * speed, NO_HASTE_SECONDS, HASTE_SECONDS)
    entries = max(min(seconds * speed / TABLE_SECONDS, 2.0), min(time, 2 * size), 0.5)  # relative to 2^17
    return Plan(
        log2_table_size=17 + round(math.log2(entries)),
        num_steps=32 * round(16 * longer - 4 * haste),
        samples=1024 * round(min(max(share, MIN_SAMPLES / MAX_SAMPLES), 1.0) * MAX_SAMPLES / 1024),
        detail=round(min(max(2 * time / size, 1.0), 2.0)),
        learning_rate=round(0.01 * 2**haste, 4),
        several_rays_from=round(0.9 - 0.15 * way_between(seconds * speed, NO_HASTE_SECONDS, LATE_UNTIL_SECONDS), 3),
        thin=round(THIN * 2**haste, 3),
        eval_step_scale=round(1 - haste / 2, 3),
    )


def way_between(seconds: float, first: float, last: float) -> float:
    """Return the position of a time between two others on a logarithmic scale.

    Args:
        seconds: the time, seconds.
        first, last: the other times, seconds; `last` may be earlier.

    Returns:
        0 at or before `first`, 1 at or beyond `last`.
    """
    return min(max(math.log(seconds / first) / math.log(last / first), 0.0), 1.0)


def decide(config: InstantNGPConfig, scene: Scene) -> tuple[InstantNGPConfig, list[Decision]]:
    """Fill in the settings that depend on the time budget and the scene.

    Raises:
        ConfigError: if colours are to depend on reflected directions and not on the viewing direction.
    """
    if config.directional == "reflected" and not config.view_dependence:
        raise ConfigError("--directional reflected depends on the viewing direction; leave out --view-dependence False")
    seconds = math.inf if config.max_seconds is None else config.max_seconds
    suited = plan(seconds, scene.image_size, relative_speed(config.machine))
    suits = "that suits the time" if seconds < math.inf else "there is time for it"
    finer = suited.eval_step_scale if is_open(config.num_steps) else 1.0  # compensates for longer steps in training
    config, made = decide_background(config, scene)
    config, sizes = fill(
        config,
        Choice("log2_table_size", suited.log2_table_size, suits),
        Choice("num_steps", suited.num_steps, suits, "steps along the box's diagonal"),
        Choice("samples_per_batch", suited.samples, suits, "samples a step"),
    )
    config, rates = fill(
        config,
        Choice("learning_rate", suited.learning_rate, suits),
        Choice("train_rays_per_pixel_from", suited.several_rays_from, suits, "share of time with one ray per pixel"),
        Choice("eval_step_scale", finer, suits, "length of a step in rendering"),
        Choice("thin_gradients", suited.thin, suits, "gradients thinned, of the mean"),
    )
    config, _ = fill(config, Choice("detail", suited.detail, suits))  # reported with the resolution below
    pays = config.log2_table_size >= MIN_SPARSE_TABLE
    config, more = fill(
        config,
        finest_cells(scene, config.detail),
        Choice("sparse_updates", pays, f"tables have 2^{config.log2_table_size} entries a level"),
    )
    config, few = decide_few_images(config, scene)
    hasty = suited.several_rays_from > plan(math.inf, scene.image_size).several_rays_from  # otherwise all are usual
    return config, made + sizes + more + few + (rates if hasty else [])


def make_field(config: InstantNGPConfig, scene: Scene) -> EncodedField:
    """Return a field of one hash grid and two small networks."""
    scene = foreground(config, scene)
    return EncodedField(
        scene.box,
        HashGrid.of(config, config.open_levels_until),
        config.hidden_width,
        direction_levels=4 if config.view_dependence else 0,
        unbounded=contracted_box(config, scene) is not None,
        opening=config.open_levels_until,
        reflection=reflection_of(config, config.hidden_width),
    )


def make_background(config: InstantNGPConfig, scene: Scene) -> InvertedField:
    """Return a field of the same size for the outside of the sphere."""
    grid = HashGrid.of(config, config.open_levels_until)
    return InvertedField(grid, config.hidden_width, 4 if config.view_dependence else 0)


class InstantNGP(RayModel[InstantNGPConfig], plain=True):
    """A model that learns from colours only, if there are no known distances, no proposals and no reflections."""

    losses = (COLOR_ERROR, SamplerLoss(), *KNOWN_DISTANCES, *FEW_IMAGES, PREDICTED_NORMALS)
    steps_repeat = True


METHOD = Method(
    InstantNGPConfig(),
    paper="arXiv:2201.05989",
    field=make_field,
    sampler=make_foreground_sampler,
    renderer=partial(background_renderer, make_field=make_background),
    model=InstantNGP,
    decide=decide,
)
