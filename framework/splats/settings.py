"""Settings by which Gaussians start, grow and move, and what a budget decides of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal, TypeVar

from nerfloom.base.config import AT_LEAST_0, AUTO, AppearanceConfig, Auto, Range
from nerfloom.base.decisions import Choice, Decision, fill, is_open
from nerfloom.base.device import device_kind, relative_speed
from nerfloom.base.processes import processes
from nerfloom.data.scene import Scene
from nerfloom.splats.gaussians import MAX_DEGREE
from nerfloom.splats.learning import MOST_STEPS, number_for, rate_factor
from nerfloom.splats.look import LEAST_BLUR, MOST_BLUR, OURS, Look, Sort
from nerfloom.splats.resolution import REDUCED_SHARE

PIXELS_PER_SECOND = 25 * 400 * 400
"""Pixels that training draws in a second, about, on two cores; for what is decided by the budget."""
MOST_STEPS_PER_SECOND = 100
"""However small the images are."""
MOST_GAUSSIANS, MOST_RATE = 1_000_000, 8.0
"""Maximum number of Gaussians, and factor of learning rates, that are chosen by the budget."""
LARGE_IMAGE = 250_000
"""Pixels from which training begins with images of half the size."""
LONG_RUN, NEVER = 15_000, 10**9
"""Steps of a run in which opacity is reset, which it takes a thousand steps to recover from."""
PACED_WORDS = {True: "the time is limited, not the steps", False: "they are given, or the time has no limit"}
RESET_WORDS = {
    True: ("the run is long", "resets of opacity", "every 3,000 steps"),
    False: ("the run is too short to recover from one", "resets of opacity", "none"),
}


@dataclass(frozen=True)
class SplattingConfig(
    AppearanceConfig, max_num_iterations=30_000, learning_rate=5e-3, lr_final=0.1, adam_beta2=0.99, adam_eps=1e-15
):
    """Settings of a method whose Gaussians start somewhere, grow, move and are drawn."""

    RANGES: ClassVar[dict[str, Range]] = {
        "degree": (0, MAX_DEGREE),
        "blur": (LEAST_BLUR, MOST_BLUR),
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
        "reduced_until": (0, 1),
    }
    """Allowed range of each numeric setting."""
    degree: int = 3
    """Highest degree of the spherical harmonics that colours are made of."""
    antialiased: bool = False
    """Compensate the minimum width of a Gaussian on an image by its opacity (Mip-Splatting)."""
    blur: float = OURS.blur
    """Variance added to every Gaussian on an image, pixels^2: 0.3 in 3DGS and gsplat, 0.1 in Mip-Splatting."""
    sort: Sort = OURS.sort
    """What Gaussians are sorted by. distance: from the camera, so that turning it changes nothing. depth: along its
    axis, as 3DGS, gsplat and most viewers sort."""
    num_gaussians: Auto[int] = AUTO
    """Maximum number of Gaussians; by the budget if not given."""
    start: Literal["auto", "points", "field", "silhouettes", "random"] = "auto"
    """Where Gaussians start: at the points of a reconstruction, on surfaces that a short run of a field finds, in
    the visual hull of the images' silhouettes, or anywhere in the box. auto: the first of points and field that there
    is."""
    start_gaussians: Auto[int] = AUTO
    """Gaussians at the start, and their maximum at the points of a reconstruction; two thirds of --num-gaussians if not
    given."""
    field_steps: Auto[int] = AUTO
    """Maximum number of training steps of that field; by the budget if not given. They end after a fifth of
    --max-seconds."""
    rate_factor: Auto[float] = AUTO
    """Factor of all learning rates; by the budget if not given, as fewer steps have to go farther."""
    position_rate: float = 8e-5
    """Learning rate of centres before that factor, in sizes of the scene."""
    reduced_until: Auto[float] = AUTO
    """Share of the budget in which images are half as wide and high, a quarter in its first half, and so on. If not
    given: 0.4 of large images, else 0."""
    paced: Auto[bool] = AUTO
    """Whether measured times of steps change the share of reduced images and the steps between moves. If not given:
    with --max-seconds, if neither --reduced-until nor --steps-per-move is given."""
    strategy: Literal["adc", "mcmc"] = "adc"
    """How Gaussians come and go. adc: transparent ones are dropped, and those whose image positions have large
    gradients are cloned or split (adaptive density control of 3DGS). mcmc: transparent ones are moved to opaque ones
    (3DGS-MCMC)."""
    growth_end: float = 0.8
    """Share of the budget after which no Gaussian is added or moved."""
    steps_per_move: Auto[int] = AUTO
    """Steps between two changes of the Gaussians' number. If not given: 100, or fewer, down to 20, where too few
    changes would be left to reach --num-gaussians."""
    steps_per_reset: Auto[int] = AUTO
    """Steps after which strategy adc makes all Gaussians nearly transparent; by the budget if not given."""
    noise: float | None = None
    """Noise of nearly transparent Gaussians, times the learning rate of centres; by the start if not given."""
    opacity_penalty: float | None = None
    """Weight of the mean opacity in the loss; by the start if not given."""
    scale_penalty: float | None = None
    """Weight of the mean scale, in scene extents, in the loss; by the start if not given."""

    def look(self) -> Look:
        """Return how Gaussians are drawn."""
        return Look(self.antialiased, self.blur, self.sort)


SplattingConfigT = TypeVar("SplattingConfigT", bound=SplattingConfig)


def decide_splatting(config: SplattingConfigT, scene: Scene) -> tuple[SplattingConfigT, list[Decision]]:
    """Decide how many Gaussians there are and how fast they learn, by the budget and the size of the images.

    Returns:
        The settings, and a record of each that was filled in.
    """
    pixels = scene.image_pixels or scene.image_size**2
    speed = min(PIXELS_PER_SECOND / pixels, MOST_STEPS_PER_SECOND)  # steps a second of two threads
    seconds = min(config.max_seconds or math.inf, (config.max_num_iterations or math.inf) / speed)
    usual = relative_speed(config.machine) if device_kind(config.machine) == "cpu" else 1.0
    count, factor = number_for(seconds, MOST_GAUSSIANS), rate_factor(usual * speed * seconds, MOST_RATE)
    why = "that suits the time"
    config, made = fill(config, Choice("num_gaussians", count, why, "Gaussians", f"up to {count:,}"))
    large = pixels > LARGE_IMAGE
    detail = "large images can wait" if large else "the images are small"
    free = is_open(config.reduced_until) and is_open(config.steps_per_move) and processes().count == 1
    paced = free and config.max_seconds is not None
    first, most = max(config.num_gaussians * 2 // 3, 1), 800 if scene.unbounded else 400
    resets = speed * seconds >= LONG_RUN
    config, more = fill(
        config,
        Choice("start_gaussians", first, "the others are added", "Gaussians at the start", f"{first:,}"),
        Choice("field_steps", int(min(max(2 * seconds, 120), most)), why, "steps of a field to start from"),
        Choice("paced", paced, PACED_WORDS[paced], "sizes by measured steps"),
        Choice("reduced_until", REDUCED_SHARE if large else 0.0, detail, "share of the budget with reduced images"),
        Choice("steps_per_reset", 3_000 if resets else NEVER, *RESET_WORDS[resets]),
        Choice("steps_per_move", MOST_STEPS, "the paper has it so", "steps between changes of the number"),
        Choice("rate_factor", round(factor, 2), "fewer steps have to go farther", "factor of learning rates"),
    )
    return config, made + more
