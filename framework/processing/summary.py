"""The final report: number of registered images, time, and advice if too few are registered."""

from __future__ import annotations

from dataclasses import dataclass

from nerfloom.base.counts import counted
from nerfloom.processing.parallax import NO_PARALLAX, WITHOUT

MIN_REGISTERED = 0.8
"""Advice is given if a smaller fraction of images is registered."""


@dataclass(frozen=True)
class Summary:
    """Figures of a reconstruction."""

    images: int
    """Number of readable images."""
    unreadable: int
    """Number of unreadable images."""
    registered: int
    """Number of images in the largest model, which is kept."""
    other_models: tuple[int, ...]
    """Number of images in each of the other models."""
    points: int
    """Number of sparse points."""
    reprojection_error: float
    """Mean reprojection error, pixels."""
    matching: str
    """Rule for selecting pairs."""
    pairs: int
    """Number of matched image pairs."""
    turned: float
    """Fraction of image pairs with a camera that only rotated (`parallax.share_that_turned`)."""
    seconds: dict[str, float]
    """Seconds by stage."""


def lines(summary: Summary) -> list[str]:
    """Return the figures of `summary` as lines of text."""
    share = summary.registered / summary.images
    stages = ", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in summary.seconds.items())
    messages = [
        f"registered: {summary.registered} of {summary.images} images ({share:.0%}); "
        f"{counted(summary.points, 'points')}; mean reprojection error {summary.reprojection_error:.2f} pixels",
        f"time: {sum(summary.seconds.values()):.1f} s ({stages})",
    ]
    if summary.other_models:
        sizes = ", ".join(map(str, summary.other_models))
        messages.append(f"left out: {len(summary.other_models)} unconnected models, with {sizes} images")
    if summary.turned >= WITHOUT:
        messages.append(f"warning: {NO_PARALLAX}")
    if share < MIN_REGISTERED:
        messages.append(f"few images were registered. {advice(summary.matching)}")
    return messages


def advice(matching: str) -> str:
    """Return advice for images that cannot be connected by the `matching` rule for pairs."""
    steps = [
        "take images with more overlap (two thirds or more with the next), sharp, in constant light",
        "set --max-num-features 16384 and --max-image-size 3200",
    ]
    if matching != "exhaustive":
        steps.append("set --matching-method exhaustive")
    if matching == "sequential":
        steps.append("take more frames (--num-frames-target, or a larger --sequential-overlap)")
    return "To improve: " + "; ".join(steps) + "."
