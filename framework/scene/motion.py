"""Settings of ray methods that learn motion, and what the number of the images' times decides."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from nerfloom.base.config import AT_LEAST_0, AUTO, Auto, Range, RayConfig
from nerfloom.base.decisions import Choice
from nerfloom.data.scene import Scene

TIMES_A_VERTEX, LEAST_VERTICES, MOST_VERTICES = 6, 3, 2**10
"""Times of images for each vertex along an axis of time, and the minimum and maximum number of vertices. The paper's
settings have 2, for training fifty times as long as minutes on a processor are: docs/notes/motion.md."""


TIMES_A_SLICE, MOST_SLICES = 9, 16
"""Times of images for each slice of time in the occupancy grid, and the maximum number of slices."""


@dataclass(frozen=True)
class MotionConfig(RayConfig):
    """Settings of a method that learns motion."""

    RANGES: ClassVar[dict[str, Range]] = {
        "time_slices": (1, 2**10),
        "empty_loss_mult": AT_LEAST_0,
        "transparent_share": (0.001, 1),
    }
    """Allowed ranges."""
    smallest_box: bool = True
    """Learn only the part of the box that the images' silhouettes leave at any time (occupancy)."""
    time_slices: Auto[int] = AUTO
    """Equal parts of time with cells of their own in the occupancy grid, so that a ray skips what is empty at its own
    time (occupancy). If not given: one for some nine times of the images, 16 at most, if silhouettes show what is
    empty; else 1."""
    empty_loss_mult: float = 0.0
    """Weight of the opacity of rays through transparent pixels, which are empty at the time of their image; 0 for
    none."""
    transparent_share: float = 1.0
    """Share of the drawn transparent pixels that are rendered, at random, and count as many times more; 1 for all."""


def vertices_in_time(scene: Scene) -> int:
    """Return the number of vertices along an axis of time, by the number of times of the images of `scene`."""
    return min(max(scene.num_times // TIMES_A_VERTEX, LEAST_VERTICES), MOST_VERTICES)


def slices_choice(scene: Scene, sampler: str) -> Choice:
    """Return the slices of time in the occupancy grid that suit the scene.

    Args:
        scene: properties of the data.
        sampler: the chosen sampler.
    """
    shown = scene.moving and scene.has_alpha and not scene.unbounded and sampler == "occupancy"
    count = min(max(scene.num_times // TIMES_A_SLICE, 1), MOST_SLICES) if shown else 1
    reason = f"the images have {scene.num_times} times"
    return Choice("time_slices", count, reason, "slices of time in the occupancy grid")
