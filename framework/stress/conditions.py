"""Hard conditions: the changes of images and settings in each, and the expected outcome.

Under every condition, a run must not crash, must end with finite parameters, and may drop only steps with spoiled
pixels. Each condition has a maximum loss of PSNR against the plain run; if a larger loss has a reason that no method
can avoid, the condition states it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from nerfloom.base.config import TrainConfig
from nerfloom.base.errors import FlagError, nearest
from nerfloom.data.dataset import Dataset
from nerfloom.stress.faults import Spoil, spoiled_pixel, spoiled_pose
from nerfloom.stress.scenes import Views, ball_views
from nerfloom.stress.variants import first_image, moved, one_pixel, plain_colored, transparent, twice, with_distractors
from nerfloom.testing.ball import RADIUS

MAX_LOSS = 2.0
"""Default maximum loss of PSNR, dB; compare the loss of `another-seed`."""
MAX_LOSS_OF_OTHER_PICTURES = 5.0
"""Maximum loss of PSNR, dB, if the test views show more or less of the ball than the plain run's views.

If test views are easier than the plain ones (all white, black or transparent), or show the same part of the ball (4
degrees), the maximum is `MAX_LOSS`.
"""

DISTRACTED = 0.1
"""Share of pixels that distractors cover."""
A_THIRD = "a third of the steps teach nothing, as they should"

Change = Callable[[Views], Views]
"""Function from the plain images to the changed ones."""
Settings = Callable[[TrainConfig], dict[str, Any]]
"""Function from the settings of the plain run to the changed ones, as plain values by name."""


def _same(views: Views) -> Views:
    return views


def _none(config: TrainConfig) -> dict[str, Any]:
    return {}


@dataclass(frozen=True)
class Condition:
    """A hard condition and its expected outcome."""

    name: str
    """Name for the command line and the table."""
    what: str
    """Description for people."""
    change: Change = _same
    """Change of the images."""
    settings: Settings = _none
    """Changed settings of the run."""
    rays: int | None = None
    """Number of rays per step; None for the method's."""
    spoil: Spoil | None = None
    """Change of every third batch; None without."""
    allowed: float = MAX_LOSS
    """Maximum loss of PSNR against the plain run, dB; with more, the outcome is degraded."""
    reason: str | None = None
    """Reason why more may be lost; None without."""
    may_refuse: bool = False
    """Whether a clear error (NerfloomError) is accepted instead of a result."""
    may_skip: bool = False
    """Whether any step may be dropped because it is not finite."""
    ball_only: bool = False
    """Whether the condition needs images from other positions, which only the ball provides."""


def _both(change: Callable[[Dataset], Dataset]) -> Change:
    """Return a change of training and test images."""
    return lambda views: views.each(change)


def _train(change: Callable[[Dataset], Dataset]) -> Change:
    """Return a change of the training images only."""
    return lambda views: replace(views, train=change(views.train))


def _moved(scale: float = 1.0, shift: float = 0.0, placed: bool = False) -> Change:
    return lambda views: moved(views, scale, shift, placed)


def _fixed(**settings: Any) -> Settings:
    return lambda config: settings


# Reasons why more may be lost, if shared or long.
UNIT = "density is per unit of length, and starts at about 1: a format that does not place cameras wants --scale-factor"
FAR_OFF = "float32 resolves 0.001 there, and frequency encodings nothing: such a scene should be placed"

PLAIN = Condition("plain", "the reference: no hard condition")
CONDITIONS = (
    PLAIN,
    # -- images
    Condition("all-white", "white opaque photographs", _both(lambda d: plain_colored(d, 255))),
    Condition("all-black", "black opaque photographs", _both(lambda d: plain_colored(d, 0))),
    Condition("all-transparent", "photographs of nothing, alpha 0", _both(transparent)),
    Condition(
        "one-image",
        "a single photograph",
        _train(first_image),
        reason="it shows little of the other sides",
        may_refuse=True,
    ),
    Condition(
        "one-pixel-images",
        "photographs of one pixel",
        _both(one_pixel),
        allowed=MAX_LOSS_OF_OTHER_PICTURES,
        reason="there are only a dozen pixels: each is the mean of an image, and its ray sees the centre alone",
    ),
    Condition("duplicate-cameras", "every photograph and its camera twice", _train(twice)),
    Condition(
        "distractors",
        "discs at other places in each training photograph, 10 % of its pixels",
        _train(lambda d: with_distractors(d, DISTRACTED)),
        reason="a dozen small photographs: what a disc hides is seen in few others",
        may_refuse=True,
    ),
    # -- cameras
    Condition(
        "field-of-view-4",
        "images 4 degrees wide, from correspondingly far away",
        lambda _: ball_views(4.0),
        ball_only=True,
    ),
    Condition(
        "field-of-view-170",
        "images 170 degrees wide, from inside: from outside, hardly any pixel would see the ball",
        lambda _: ball_views(170.0, RADIUS / 2),
        allowed=MAX_LOSS_OF_OTHER_PICTURES,
        reason="a pixel in the middle spans over 40 degrees",
        ball_only=True,
    ),
    Condition(
        "inside",
        "cameras inside the object, which fills all pictures",
        lambda _: ball_views(90.0, RADIUS / 2),
        allowed=MAX_LOSS_OF_OTHER_PICTURES,
        reason="matter right before the cameras explains a few photographs as well as walls do",
        ball_only=True,
    ),
    # -- units and origin: see `variants.moved` for the two ways that formats place a scene
    Condition("scale-1e-6", "a scene a million times smaller, not placed", _moved(1e-6), reason=UNIT),
    Condition("scale-1e6", "a scene a million times larger, not placed", _moved(1e6), reason=UNIT),
    Condition("shift-1e4", "a scene 10,000 units off along each axis, not placed", _moved(shift=1e4), reason=FAR_OFF),
    Condition("placed", "cameras placed as those of captures are", _moved(placed=True)),
    Condition("scale-1e-6-placed", "a scene a million times smaller, then placed", _moved(1e-6, placed=True)),
    Condition("scale-1e6-placed", "a scene a million times larger, then placed", _moved(1e6, placed=True)),
    Condition("shift-1e4-placed", "a scene 10,000 units off, then placed", _moved(shift=1e4, placed=True)),
    # -- training
    Condition(
        "another-seed",
        "the plain run with another seed: the usual difference between runs",
        settings=lambda config: {"machine": {"seed": config.machine.seed + 1}},
    ),
    Condition(
        "learning-rate-x10",
        "ten times the learning rate",
        settings=lambda config: {"learning_rate": 10 * config.learning_rate},
        reason="ten times the tuned rate",
    ),
    Condition("float32", "--mixed-precision False", settings=_fixed(mixed_precision=False)),
    Condition("bfloat16", "--mixed-precision True", settings=_fixed(mixed_precision=True)),
    Condition(
        "float16",
        "--mixed-precision float16, which is not supported: its range would need a gradient scaler",
        settings=_fixed(mixed_precision="float16"),
        may_refuse=True,
    ),
    Condition(
        "1-ray",
        "one ray a step",
        settings=_fixed(train_rays_per_pixel_from=1.0),  # never several rays per pixel
        rays=1,
        reason="it sees only one pixel per step",
    ),
    Condition("8192-rays", "8192 rays a step", rays=8192, reason="steps take longer: fewer may fit into the time"),
    # -- invalid data
    Condition("nan-pixels", "a NaN pixel in every third batch", spoil=spoiled_pixel(math.nan), reason=A_THIRD),
    Condition("inf-pixels", "an infinite pixel in every third batch", spoil=spoiled_pixel(math.inf), reason=A_THIRD),
    Condition(
        "nan-pose",
        "a camera with a NaN pose that its format has not refused",
        _train(lambda d: spoiled_pose(d, math.nan)),
        may_refuse=True,
        may_skip=True,
    ),
)


def select(names: Sequence[str]) -> list[Condition]:
    """Return the plain run and the conditions with the given `names`, in the order of `CONDITIONS`; all without names.

    Raises:
        FlagError: if there is no such condition; the message suggests the nearest.
    """
    all_names = [condition.name for condition in CONDITIONS]
    for name in names:
        if name not in all_names:
            raise FlagError(f"--only: there is no condition '{name}'. {nearest(name, all_names)}")
    return [condition for condition in CONDITIONS if condition is PLAIN or not names or condition.name in names]
