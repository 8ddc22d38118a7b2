"""Settings of ray methods that learn motion, and what the number of the images' times decides about them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, TypeVar

from framework.base.config import AT_LEAST_0, AUTO, Auto, Range, RayConfig
from framework.base.decisions import Choice, Decision, fill
from framework.data.scene import Scene

TIMES_A_VERTEX, LEAST_VERTICES, MOST_VERTICES = 6, 3, 2**10
"""Times of images for each vertex along an axis of time, and the minimum and maximum number of vertices. The paper's
settings have 2, for training fifty times as long as minutes on a processor are: docs/notes/motion.md."""
TIMES_A_SLICE, MOST_SLICES = 4, 16
"""Times of images in a slice of the occupancy grid, and maximum number of slices, whose cells take memory."""


@dataclass(frozen=True)
class MotionConfig(RayConfig):
    """Settings of a method that learns motion."""

    RANGES: ClassVar[dict[str, Range]] = {
        "time_slices": (1, 2**10),
        "empty_loss_mult": AT_LEAST_0,
        "transparent_share": (0.001, 1),
    }
    """Allowed ranges."""
    time_slices: Auto[int] = AUTO
    """Equal parts of time with cells of their own in the occupancy grid, so that a ray skips what is empty at its own
    time (occupancy). If not given: one for each four times of the images, at most 16."""
    empty_loss_mult: float = 0.01
    """Weight of the opacity of rays through transparent pixels, which are empty at the time of their image; 0 for
    none."""
    transparent_share: float = 0.25
    """Share of the drawn transparent pixels that are rendered, at random, and count as many times more; 1 for all."""


ConfigT = TypeVar("ConfigT", bound=MotionConfig)


def vertices_in_time(scene: Scene) -> int:
    """Return the number of vertices along an axis of time, by the number of times of the images of `scene`."""
    return min(max(scene.num_times // TIMES_A_VERTEX, LEAST_VERTICES), MOST_VERTICES)


def decide_motion(config: ConfigT, scene: Scene, sampler: str) -> tuple[ConfigT, list[Decision]]:
    """Decide the number of slices of time of the occupancy grid.

    Args:
        config: the method's settings; those left open are filled in.
        scene: properties of the scene.
        sampler: the method's sampler, decided.

    Returns:
        the settings, and the decisions that were made; none for a still scene, or without an occupancy grid of one box.
    """
    slices = min(max(scene.num_times // TIMES_A_SLICE, 1), MOST_SLICES)
    reason = f"the images have {scene.num_times} times"
    config, made = fill(config, Choice("time_slices", slices, reason, "slices of time in the occupancy grid"))
    return config, made * (scene.moving and not scene.unbounded and sampler == "occupancy")
