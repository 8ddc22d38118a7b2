"""Decision whether to leave out what other images contradict (`--robust`), from the images alone."""

from __future__ import annotations

from typing import TypeVar

from nerfloom.base.config import TrainConfig
from nerfloom.base.decisions import Choice, Decision, fill, is_open
from nerfloom.data.dataset import Dataset
from nerfloom.scene.transients import transient_share

ConfigT = TypeVar("ConfigT", bound=TrainConfig)
CLEAR = 0.02
"""Minimum `transient_share` for a scout. It is at most 0.003 in seven captures and two courtyards where nothing moves,
and at least 0.029 in five of these captures with something else pasted over 5 % of each image."""
OPTION = "things that come and go"
"""Name of the decision in the profile."""


def robust_chosen(config: ConfigT, dataset: Dataset) -> tuple[ConfigT, list[Decision]]:
    """Fill in `--robust` if it is open: a scout if something stands in single images, else off.

    Images with alpha show a cut-out object, images with times show motion, and several scenes have no common scout.
    These are not examined.

    Args:
        config: the run's settings.
        dataset: the training images.

    Returns:
        The settings, and a decision if there is a scout, or if photographs could not be judged.
    """
    scene = dataset.scene
    if not is_open(config.robust):
        return config, []
    off = Choice("robust", "off", "")
    if scene.has_alpha or scene.moving or scene.num_scenes > 1:
        return fill(config, off)[0], []
    share = transient_share(dataset)
    if share is None:
        reason = "too few photographs show the same from nearby (with passers-by: --robust scout)"
        config, made = fill(config, Choice("robust", "off", reason, OPTION, "not looked for"))
        return config, made if scene.poses == "photographs" else []
    if share < CLEAR:
        return fill(config, off)[0], []
    reason = f"others contradict {share:.0%} of a typical photograph (else: --robust off)"
    return fill(config, Choice("robust", "scout", reason, OPTION, "left out by --robust scout"))
