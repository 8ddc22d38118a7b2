"""Settings for the start, growth and drawing of Gaussians, and the values that depend on the budget."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal, TypeVar

from nerfloom.base.config import AT_LEAST_0, AUTO, AppearanceConfig, Auto, Range, RobustConfig
from nerfloom.base.decisions import Choice, Decision, fill, is_open
from nerfloom.base.device import device_kind, relative_speed
from nerfloom.base.processes import processes
from nerfloom.data.scene import Scene
from nerfloom.splats.gaussians import MAX_DEGREE
from nerfloom.splats.learning import MAX_STEPS, number_for, rate_factor
from nerfloom.splats.look import MAX_BLUR, MIN_BLUR, OURS, Look, Sort
from nerfloom.splats.resolution import REDUCED_SHARE

PIXELS_PER_SECOND = 25 * 400 * 400
"""Approximate number of pixels that training draws per second on two cores."""
MAX_STEPS_PER_SECOND = 100
"""Maximum training speed assumed for small images."""
MAX_GAUSSIANS, MAX_RATE = 1_000_000, 8.0
"""Largest number of Gaussians and largest factor of learning rates that a budget chooses."""
LARGE_IMAGE = 250_000
"""Maximum number of pixels of an image that training begins with at full size; larger images are reduced at first."""
LONG_RUN, NEVER = 15_000, 10**9
"""Minimum length of a run with resets of opacity, steps, and a period that is never reached. Recovery from a reset
takes a thousand steps."""
CLOSED_FIELD_STEPS, MAX_CLOSED_FIELD_STEPS = 10, 2_000
"""Steps of a field to start from, for each second of the budget, and their maximum, if every ray ends in the box. At
first the whole box is fog there: a ray has hundreds of samples, so a step has few rays and shows little."""
PACED_WORDS = {True: "the time is limited, not the steps", False: "they are given, or the time has no limit"}
BLURS = {
    True: (0.1, "images with alpha are rendered, and sharp to the pixel"),
    False: (OURS.blur, "photographs are less sharp than their pixels"),
}
"""Blur of Gaussians, and its reason, with alpha and without (docs/notes/splatting.md)."""
RESET_WORDS = {
    True: ("the run is long", "resets of opacity", "every 3,000 steps"),
    False: ("the run is too short to recover from one", "resets of opacity", "none"),
}


@dataclass(frozen=True)
class SplattingConfig(
    RobustConfig,
    AppearanceConfig,
    max_num_iterations=30_000,
    learning_rate=5e-3,
    lr_final=0.1,
    adam_beta2=0.99,
    adam_eps=1e-15,
):
    """Settings of a method that trains Gaussians."""

    RANGES: ClassVar[dict[str, Range]] = {
        "degree": (0, MAX_DEGREE),
        "blur": (MIN_BLUR, MAX_BLUR),
        "num_gaussians": (1, 10_000_000),
        "start_gaussians": (1, 10_000_000),
        "field_steps": (1, math.inf),
        "rate_factor": AT_LEAST_0,
        "position_rate": AT_LEAST_0,
        "steps_per_reset": (1, 10**9),
        "growth_end": (0, 1),
        "steps_per_move": (1, 10**9),
        "noise": AT_LEAST_0,
        "opacity_penalty": AT_LEAST_0,
        "scale_penalty": AT_LEAST_0,
        "flatness_penalty": AT_LEAST_0,
        "normal_loss_mult": AT_LEAST_0,
        "distortion_loss_mult": AT_LEAST_0,
        "reduced_until": (0, 1),
        "memory_limit": AT_LEAST_0,
    }
    changing_light = "affine"
    degree: int = 3
    """Highest degree of the spherical harmonics of colours."""
    antialiased: bool = False
    """Lower the opacity of small Gaussians to compensate for their blur (Mip-Splatting)."""
    blur: Auto[float] = AUTO
    """Variance added to every Gaussian on an image, pixels^2: 0.3 in 3DGS, gsplat and most viewers, 0.1 in
    Mip-Splatting. Default: 0.1 if the images have alpha, else 0.3."""
    sort: Sort = OURS.sort
    """Sort key of Gaussians. distance: distance from the camera; turning the camera does not change it. depth: depth
    along the camera's axis, as in 3DGS, gsplat and most viewers; not of panoramas and fisheyes over 178 degrees."""
    num_gaussians: Auto[int] = AUTO
    """Maximum number of Gaussians. Default: from the budget."""
    start: Literal["auto", "points", "field", "silhouettes", "random"] = "auto"
    """Where Gaussians start. points: at the points of a reconstruction. field: on surfaces from a short training of a
    field. silhouettes: in the visual hull of images with alpha. random: anywhere in the box. auto: points if the data
    has them, else field."""
    start_gaussians: Auto[int] = AUTO
    """Number of Gaussians at the start; the maximum number if they start at points. Default: two thirds of
    --num-gaussians."""
    field_steps: Auto[int] = AUTO
    """Maximum number of training steps of the field of --start field. It trains for at most a fifth of --max-seconds,
    or two fifths where every ray ends in the box. Default: from the budget."""
    rate_factor: Auto[float] = AUTO
    """Factor of all learning rates. Default: from the budget; shorter runs have a larger factor."""
    position_rate: float = 8e-5
    """Learning rate of centres relative to the size of the scene, before --rate-factor."""
    reduced_until: Auto[float] = AUTO
    """Share of the budget with reduced images: half the size, a quarter in the first half of the share, and so on.
    Default: 0.4 for large images, else 0."""
    paced: Auto[bool] = AUTO
    """Adapt the share of reduced images and --steps-per-move to measured step times. Default: with --max-seconds in one
    process, unless --reduced-until or --steps-per-move is given."""
    strategy: Literal["adc", "mcmc", "relocation"] = "adc"
    """How Gaussians are added and removed. adc: drop transparent Gaussians; clone or split Gaussians with large
    gradients of the image position (adaptive density control of 3DGS). mcmc: move transparent Gaussians to opaque ones
    (3DGS-MCMC). relocation: move them to Gaussians that are opaque or have large gradients (FreeTimeGS)."""
    growth_end: float = 0.8
    """Share of the budget until the last Gaussian is added or moved."""
    steps_per_move: Auto[int] = AUTO
    """Steps between two changes of the number of Gaussians. Default: 100, or down to 20 in runs that are too short to
    reach --num-gaussians otherwise."""
    steps_per_reset: Auto[int] = AUTO
    """With --strategy adc, steps between resets that make all Gaussians nearly transparent. Default: from the
    budget."""
    noise: float | None = None
    """Noise on the centres of nearly transparent Gaussians, relative to their learning rate. Default: 0 if Gaussians
    start on a field's surfaces in a box that cameras see from outside, else 5e5."""
    opacity_penalty: float | None = None
    """Weight of the mean opacity in the loss. Default: 0 if Gaussians start on a field's surfaces in a box that cameras
    see from outside, else 0.002."""
    scale_penalty: float | None = None
    """Weight of the mean scale, in scene extents, in the loss. Default: 0 if Gaussians start on a field's surfaces in a
    box that cameras see from outside, else 0.01."""
    flatness_penalty: float = 0.0
    """Weight of the mean of each Gaussian's smallest scale, in scene extents, in the loss. It makes Gaussians flat, as
    in PGSR."""
    normal_loss_mult: float = 0.0
    """Weight of the disagreement between the normals of Gaussians and of the surface at the drawn distances, as in
    2DGS. It counts after 7/30 of the budget. Such steps draw a second image, of normals."""
    distortion_loss_mult: float = 0.0
    """Weight of the spread of Gaussians along each ray, as in 2DGS. It counts after 1/10 of the budget. Such steps draw
    a further image."""
    memory_limit: float | None = None
    """Memory for the Gaussians that images show, MB (1e6 bytes). All Gaussians and Adam's state are in files in
    --cache-dir. On a CPU only. Default: all in memory."""

    def look(self) -> Look:
        """Return how Gaussians are drawn."""
        return Look(self.antialiased, self.blur, self.sort)


SplattingConfigT = TypeVar("SplattingConfigT", bound=SplattingConfig)


def decide_splatting(config: SplattingConfigT, scene: Scene) -> tuple[SplattingConfigT, list[Decision]]:
    """Fill in the number of Gaussians and their learning rates from the budget and the size of the images.

    Returns:
        The settings, and a record of each that was filled in.
    """
    pixels = scene.image_pixels or scene.image_size**2
    speed = min(PIXELS_PER_SECOND / pixels, MAX_STEPS_PER_SECOND)  # steps a second of two threads
    seconds = min(config.max_seconds or math.inf, (config.max_num_iterations or math.inf) / speed)
    usual = relative_speed(config.machine) if device_kind(config.machine) == "cpu" else 1.0
    count, factor = number_for(seconds, MAX_GAUSSIANS), rate_factor(usual * speed * seconds, MAX_RATE)
    why = "that suits the time"
    config, made = fill(config, Choice("num_gaussians", count, why, "Gaussians", f"up to {count:,}"))
    large = pixels > LARGE_IMAGE
    detail = "large images can wait" if large else "the images are small"
    free = is_open(config.reduced_until) and is_open(config.steps_per_move) and processes().count == 1
    paced = free and config.max_seconds is not None
    first = max(config.num_gaussians * 2 // 3, 1)
    resets = speed * seconds >= LONG_RUN
    config, more = fill(
        config,
        Choice("start_gaussians", first, "the others are added", "Gaussians at the start", f"{first:,}"),
        Choice("field_steps", steps_of_field(scene, seconds), why, "steps of a field to start from"),
        Choice("paced", paced, PACED_WORDS[paced], "sizes by measured steps"),
        Choice("reduced_until", REDUCED_SHARE if large else 0.0, detail, "share of the budget with reduced images"),
        Choice("steps_per_reset", 3_000 if resets else NEVER, *RESET_WORDS[resets]),
        Choice("steps_per_move", MAX_STEPS, "the paper has it so", "steps between changes of the number"),
        Choice("rate_factor", round(factor, 2), "fewer steps have to go farther", "factor of learning rates"),
        Choice("blur", *BLURS[scene.has_alpha], "blur, pixels^2"),
    )
    return config, made + more


def steps_of_field(scene: Scene, seconds: float) -> int:
    """Return the maximum number of training steps of the field that Gaussians start from.

    Args:
        scene: facts about the data.
        seconds: the budget, seconds.
    """
    each, most = 2, 800 if scene.unbounded else 400
    if scene.ends_in_box:
        each, most = CLOSED_FIELD_STEPS, MAX_CLOSED_FIELD_STEPS
    return int(min(max(each * seconds, 120), most))
