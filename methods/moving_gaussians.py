"""Moving Gaussians: splats with a moment, a duration and a velocity, for scenes that move.

Wang et al., "FreeTimeGS: Free Gaussian Primitives at Anytime Anywhere for Dynamic Scene Reconstruction", CVPR 2025.
There is no network: a Gaussian moves along a line and is visible around its moment, so a curved path takes several.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from nerfloom import Decision, LearnsMotion, Method, Optimised, Scene
from nerfloom.base.config import AT_LEAST_0, AUTO, Auto, Range
from nerfloom.base.decisions import Choice, fill
from nerfloom.base.errors import ConfigError
from nerfloom.data.dataset import Dataset
from nerfloom.kernels.splats.project import MIN_ALPHA
from nerfloom.methods import gaussian_splatting
from nerfloom.methods.gaussian_splatting import GaussianSplatting, GaussianSplattingConfig
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.table import Column

DURATIONS: Range = (1e-4, 1e3)
"""Allowed range of a duration, in the time from 0 to 1. Above about 10 nothing fades."""
MOMENT_RATE, DURATION_RATE = 1.6e-4, 5e-3
"""Learning rates of moments, in the time from 0 to 1, and of the logarithms of durations, before --rate-factor."""
MAX_LOGIT = 30.0
"""Maximum logit before fading. Its opacity is within 1e-13 of 1, and its exponential is finite in float32."""


@dataclass(frozen=True)
class MovingGaussiansConfig(GaussianSplattingConfig, noise=0.0, opacity_penalty=0.0, scale_penalty=0.0):
    """Settings of moving-gaussians."""

    RANGES: ClassVar[dict[str, Range]] = {
        "velocity_rate": AT_LEAST_0,
        "start_duration": DURATIONS,
        "min_duration": DURATIONS,
    }
    GONE: ClassVar[dict[str, Any]] = {"moment_rate": MOMENT_RATE, "duration_rate": DURATION_RATE}
    velocity_rate: float = 1.6e-3
    """Learning rate of velocities, in sizes of the scene for the time from 0 to 1, before --rate-factor."""
    start_duration: float = 0.1
    """Duration of Gaussians at the start: the standard deviation of their visibility, in the time from 0 to 1."""
    min_duration: Auto[float] = AUTO
    """Minimum duration, in the time from 0 to 1. Default: half the time between images. A shorter one would be seen in
    one image and leave nothing in between."""


def decide(config: MovingGaussiansConfig, scene: Scene) -> tuple[MovingGaussiansConfig, list[Decision]]:
    """Fill in the settings that depend on the budget and the scene."""
    shortest = max(0.5 / (scene.num_times or scene.num_cameras), DURATIONS[0])
    made: list[Decision] = []
    if scene.moving:
        blurred = "a field of all times is blurred"
        config, made = fill(config, Choice("field_depth_mult", 0.0, blurred, "weight of a field's distances"))
    config, of_splats = gaussian_splatting.decide(config, scene)
    config, of_time = fill(config, Choice("min_duration", shortest, "images are twice as far apart in time"))
    if not scene.moving:
        of_time = [Decision("motion", "left out", "the images have no times")]
    return config, made + of_splats + of_time


class MovingGaussians(GaussianSplatting, LearnsMotion):
    """A model of Gaussians that move and fade; for a scene without times it is gaussian-splatting."""

    config: MovingGaussiansConfig

    def declared_columns(self) -> dict[str, Column]:
        usual, config = super().declared_columns(), self.config
        if not self.scene.moving:
            return usual
        velocity, moment, duration = (
            config.rate_factor * rate for rate in (config.velocity_rate, MOMENT_RATE, DURATION_RATE)
        )
        return {
            **usual,
            "velocities": Column((3,), Optimised("velocities", velocity, sparse=True), in_extents=True),
            "moments": Column((), Optimised("moments", moment, sparse=True)),
            "log_durations": Column((), Optimised("durations", duration, schedule="constant", sparse=True)),
        }

    def set_gaussians(self, gaussians: Gaussians) -> None:
        """Replace the Gaussians. New ones without motion stand still, at random moments, for a long time."""
        if self.scene.moving:
            usual = still(gaussians, max(self.config.start_duration, self.config.min_duration))
            gaussians = replace(gaussians, extras={**usual, **gaussians.extras})
        super().set_gaussians(gaussians)

    def start(self, dataset: Dataset) -> None:
        if self.scene.moving and self.config.start == "silhouettes":
            raise ConfigError("--start silhouettes: this scene moves, and has no visual hull; leave out --start")
        super().start(dataset)

    def start_without_points(self) -> Literal["field", "silhouettes", "random"]:
        # A still field blurs moving things, but it shows far surroundings, where no box says where to begin.
        in_a_box = self.scene.moving and not self.scene.unbounded
        return "random" if in_a_box else super().start_without_points()

    def at_time(self, gaussians: Gaussians, time: float | None) -> Gaussians:
        return gaussians if time is None else shown_at(gaussians, time)

    def gaussians(self, time: float | None = None) -> Gaussians:
        """Return the Gaussians at a time that have not faded, without gradient; without a time all of them, at rest."""
        found = super().gaussians(time)
        # Gaussians with NaN stay here: callers count and report them.
        return found if time is None else found[~(torch.sigmoid(found.logits) <= MIN_ALPHA)]

    def penalised_opacities(self, gaussians: Gaussians, time: float | None) -> Tensor:
        """Return the opacities (N,) at a time as the paper's 4D regularisation counts them.

        The factor of time has no gradient. Otherwise the penalty would shorten durations.
        """
        if time is None:
            return super().penalised_opacities(gaussians, time)
        rest = self.at_rest()
        return torch.sigmoid(rest.logits) * log_visibility(rest, time).detach().exp()

    @torch.no_grad()
    def after_every_step(self, step: int, progress: float, finite: bool | Tensor) -> None:
        super().after_every_step(step, progress, finite)
        if self.scene.moving:
            # A Gaussian that no image can show any more has no gradient, and its opacity at rest keeps it alive.
            self.columns["log_durations"].values.data.clamp_(min=math.log(self.config.min_duration))
            self.columns["moments"].values.data.clamp_(0, 1)


def still(gaussians: Gaussians, duration: float) -> dict[str, Tensor]:
    """Return the columns of motion of Gaussians that stand still, at random moments.

    Args:
        gaussians: N Gaussians.
        duration: their duration, in the time from 0 to 1.

    Returns:
        `velocities` (N, 3), `moments` (N,), uniform in [0, 1), and `log_durations` (N,).
    """
    moments = torch.rand_like(gaussians.logits)
    return {
        "velocities": torch.zeros_like(gaussians.log_scales),
        "moments": moments,
        "log_durations": torch.full_like(moments, math.log(duration)),
    }


def log_visibility(gaussians: Gaussians, time: float) -> Tensor:
    """Return the logarithm (N,) of the factor of opacity at a time: -((t - moment) / duration)^2 / 2.

    Args:
        gaussians: N Gaussians at rest, with `moments` and `log_durations`.
        time: t, in [0, 1].
    """
    extras = gaussians.extras
    return -0.5 * ((time - extras["moments"]) * torch.exp(-extras["log_durations"])).square()


def shown_at(gaussians: Gaussians, time: float) -> Gaussians:
    """Return Gaussians with their positions and opacities at a time. Differentiable.

    A centre is at mean + velocity (t - moment). The opacity at rest is multiplied by `log_visibility`'s exponential.

    Args:
        gaussians: N Gaussians at rest, with `velocities` in scene units per unit of time, `moments` and
            `log_durations`.
        time: t, in [0, 1].

    Returns:
        N Gaussians without the columns of motion.
    """
    extras = gaussians.extras
    means = gaussians.means + (time - extras["moments"])[:, None] * extras["velocities"]
    return replace(gaussians, means=means, logits=faded(gaussians.logits, log_visibility(gaussians, time)), extras={})


def faded(logits: Tensor, log_factors: Tensor) -> Tensor:
    """Return the logits (N,) of opacities that are multiplied by factors.

    With the opacity p of a logit x and a factor w = exp(l), p w / (1 - p w) = w / (exp(-x) + 1 - w). Its logarithm is
    computed without a difference of numbers that are nearly equal, for opacities near 1 as well as near 0.

    Args:
        logits: (N,) x; larger ones count as `MAX_LOGIT`.
        log_factors: (N,) l, 0 or less.
    """
    logits = logits.clamp(max=MAX_LOGIT)
    return logits + log_factors - torch.log1p(-logits.exp() * torch.expm1(log_factors))


METHOD = Method(MovingGaussiansConfig(), paper="arXiv:2506.05348", model=MovingGaussians, decide=decide)
