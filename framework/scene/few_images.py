"""Settings of ray methods that replace images where there are few, and the decision when to use them.

Three parts, each with a setting of its own: levels of the encoding open from coarse to fine (FreeNeRF, Yang et al.
2023), views between the training cameras show smooth depth (RegNeRF, Niemeyer et al. 2022), and space right before
cameras is kept empty (FreeNeRF).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, TypeVar

from framework.base.config import AT_LEAST_0, AUTO, Auto, Range, RayConfig
from framework.base.decisions import Choice, Decision, fill
from framework.data.scene import Scene

FEW, FEW_WITH_ALPHA = 12, 8
"""Number of training images up to which there are few: of a capture, and of images whose alpha shows what is empty."""
OPEN_UNTIL = 0.5
"""Share of the budget in which the levels of the encoding open."""
SMOOTHNESS = 0.1
"""Weight of the depth's roughness in unseen views, as in RegNeRF's settings once it is annealed."""
OCCLUSION = 0.01
"""Weight of the optical depth near cameras, as in FreeNeRF's settings."""
UNSEEN_START, UNSEEN_STEPS = 10.0, 512
"""Factor of the weight of unseen views at the first step, and the number of steps in which it falls to 1."""


@dataclass(frozen=True)
class FewImagesConfig(RayConfig):
    """Settings of a method that is regularised where there are few images."""

    RANGES: ClassVar[dict[str, Range]] = {
        "open_levels_until": (0, 1),
        "unseen_loss_mult": AT_LEAST_0,
        "unseen_patches": (1, 2**14),
        "occlusion_loss_mult": AT_LEAST_0,
        "occlusion_range": AT_LEAST_0,
    }
    """Allowed ranges."""
    few_images: Auto[bool] = AUTO
    """Whether the parts below that are not set are used. If not given: for up to 12 training images of a still scene,
    or 8 with an alpha channel."""
    open_levels_until: Auto[float] = AUTO
    """Share of the budget in which the levels of the encoding open, from coarse to fine; 0 if all are open at once."""
    unseen_loss_mult: Auto[float] = AUTO
    """Weight of the roughness of depth in views between the training cameras."""
    unseen_patches: int = 8
    """Number of patches of 8 x 8 rays through such views in each step."""
    occlusion_loss_mult: Auto[float] = AUTO
    """Weight of the optical depth right before cameras."""
    occlusion_range: float = 1.2
    """Distance up to which that is, in units of the distance at which the scene starts."""


ConfigT = TypeVar("ConfigT", bound=FewImagesConfig)


def decide_few_images(config: ConfigT, scene: Scene) -> tuple[ConfigT, list[Decision]]:
    """Decide which regularisers for few images are used.

    Args:
        config: the method's settings; those left open are filled in.
        scene: properties of the scene.

    Returns:
        the settings, and the decisions that were made.
    """
    count, most = scene.num_cameras, FEW_WITH_ALPHA if scene.has_alpha else FEW
    few = count <= most and not scene.moving
    reason = f"there are {count} training images" if not scene.moving else "the scene moves"
    if few:
        reason += ", few of which contradict what fits them (else: --few-images False)"
    config, made = fill(config, Choice("few_images", few, reason, "regularisers for few images"))
    used = bool(config.few_images)
    between = used and not scene.warped and scene.camera_to_worlds is not None
    config, parts = fill(
        config,
        Choice("open_levels_until", OPEN_UNTIL if used else 0.0, "few images are explained by coarse shapes first"),
        Choice("unseen_loss_mult", SMOOTHNESS if between else 0.0, "views between the images have smooth depth"),
        Choice(
            "occlusion_loss_mult",
            OCCLUSION if used and not scene.has_alpha else 0.0,
            "nothing is right before a camera",
        ),
    )
    return config, made + (parts if used else [])


def unseen_weight(config: FewImagesConfig, step: int) -> float:
    """Return the weight of unseen views in a step, which falls linearly at first, as in RegNeRF.

    Args:
        config: the settings, decided.
        step: number of training steps done.
    """
    share = min(step / UNSEEN_STEPS, 1.0)
    return config.unseen_loss_mult * (UNSEEN_START * (1 - share) + share)
