"""Settings of ray methods that learn motion, and choices that depend on the number of image times."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from nerfloom.base.config import AUTO, Auto, Range, RayConfig
from nerfloom.base.decisions import Choice
from nerfloom.data.scene import Scene

TIMES_A_VERTEX, MIN_VERTICES, MAX_VERTICES = 6, 3, 2**10
"""Number of image times per vertex along a time axis, and the minimum and maximum number of vertices. The paper has 2
times per vertex, for a training fifty times as long as minutes on a CPU: docs/notes/motion.md."""


TIMES_A_SLICE, MAX_SLICES = 9, 16
"""Number of image times per time slice of the occupancy grid, and the maximum number of slices."""


@dataclass(frozen=True)
class MotionConfig(RayConfig):
    """Settings of a method that learns motion."""

    RANGES: ClassVar[dict[str, Range]] = {"time_slices": (1, 2**10)}
    smallest_box: bool = True
    """Learn only the part of the box that silhouettes show to be occupied at some time (occupancy)."""
    time_slices: Auto[int] = AUTO
    """Number of time slices of the occupancy grid. Each has its own cells, so that a ray skips cells that are empty at
    its own time (occupancy). auto: one per nine image times, at most 16, if silhouettes mark empty space; otherwise
    1."""
    learns_motion = True


def vertices_in_time(scene: Scene) -> int:
    """Return the number of vertices along a time axis, from the number of image times of `scene`."""
    return min(max(scene.num_times // TIMES_A_VERTEX, MIN_VERTICES), MAX_VERTICES)


def slices_choice(scene: Scene, sampler: str) -> Choice:
    """Return the number of time slices of the grid of the chosen `sampler` that suits the scene."""
    shown = scene.moving and scene.has_alpha and not scene.unbounded and sampler == "occupancy"
    count = min(max(scene.num_times // TIMES_A_SLICE, 1), MAX_SLICES) if shown else 1
    reason = f"the images have {scene.num_times} times"
    return Choice("time_slices", count, reason, "slices of time in the occupancy grid")
