"""Settings of ray methods for scenes with few images, and the decision when to use them.

There are two regularisers, each with its own setting, both from FreeNeRF (Yang et al. 2023). Levels of the encoding
open from coarse to fine, and space right before cameras should be empty.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, TypeVar

from nerfloom.base.config import AT_LEAST_0, AUTO, Auto, Range, RayConfig
from nerfloom.base.decisions import Choice, Decision, fill
from nerfloom.data.scene import Scene

MAX_FEW, MAX_FEW_WITH_ALPHA = 12, 8
"""Maximum number of training images that counts as few: in captures, and in images with empty space marked by alpha."""
OCCLUSION = 0.01
"""Weight of the optical depth near cameras, as in FreeNeRF's settings."""


@dataclass(frozen=True)
class FewImagesConfig(RayConfig):
    """Settings of a method that is regularised if there are few images."""

    RANGES: ClassVar[dict[str, Range]] = {
        "open_levels_until": (0, 1),
        "occlusion_loss_mult": AT_LEAST_0,
        "occlusion_range": AT_LEAST_0,
    }
    few_images: Auto[bool] = AUTO
    """Whether to use the defaults for few images in the settings below. auto: with up to 12 training images of a static
    scene, or 8 with an alpha channel."""
    open_levels_until: Auto[float] = AUTO
    """Fraction of the budget for opening the encoding's levels, from coarse to fine; 0 opens all at once. auto:
    0.5 with few images for vanilla-nerf, otherwise 0."""
    occlusion_loss_mult: Auto[float] = AUTO
    """Weight of the optical depth right before cameras. auto: 0.01 with few images without alpha, otherwise 0."""
    occlusion_range: float = 1.2
    """Length of rays that should be empty, relative to the distance where the scene starts."""


ConfigT = TypeVar("ConfigT", bound=FewImagesConfig)


def decide_few_images(config: ConfigT, scene: Scene, open_until: float = 0.0) -> tuple[ConfigT, list[Decision]]:
    """Decide which regularisers for few images to use.

    Args:
        config: the method's settings; open ones are filled in.
        open_until: fraction of the budget for opening the levels of the method's encoding if there are few images.

    Returns:
        The settings, and the decisions made; no decisions if there are many images.
    """
    choices = (
        Choice("open_levels_until", open_until, "few images are explained by coarse shapes first"),
        Choice("occlusion_loss_mult", OCCLUSION * (not scene.has_alpha), "space right before a camera is empty"),
    )
    count, most = scene.num_cameras, MAX_FEW_WITH_ALPHA if scene.has_alpha else MAX_FEW
    few = count <= most and not scene.moving and any(choice.value for choice in choices)
    reason = f"there are {count} training images, too few to rule out wrong geometry (else: --few-images False)"
    config, made = fill(config, Choice("few_images", few, reason, "regularisers for few images"))
    if not config.few_images:
        return fill(config, *(replace(choice, value=0.0) for choice in choices))[0], []
    config, parts = fill(config, *choices)
    return config, made + [part for part in parts if part.choice != "0"]
