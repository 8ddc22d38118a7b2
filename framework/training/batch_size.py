"""The number of rays of a training step."""

from __future__ import annotations

import math

from nerfloom.base.config import RayConfig
from nerfloom.base.pace import Pace
from nerfloom.data.sources import POINTS_UNTIL, Request
from nerfloom.training.state import State

MIN_BATCH, MAX_BATCH = 64, 2**17
"""Minimum and maximum number of rays per step, if it depends on the number of samples or on time."""
BATCH_CHANGES = 1.2
"""With CUDA graphs, resize batches only beyond this factor: a graph has a fixed size."""
SHARE_OF_LAST = 0.2
"""Weight of the last measurement in the running mean."""


class BatchSize:
    """Number of rays of a training step: as configured, for a number of samples, or adapted to the speed of steps.

    Args:
        config: settings of a method that casts rays.
        recorded: whether steps are CUDA graphs, so that each change costs time.
    """

    def __init__(self, config: RayConfig, recorded: bool) -> None:
        self.config, self.recorded = config, recorded
        self._most: float = config.num_rays_per_batch
        self._rays_per_second: float | None = None
        self._measured: Pace | None = None
        self._drawn = self._last = 0

    def keep_pace(self, pace: Pace) -> None:
        """Limit the number of rays so that enough steps fit into the time budget.

        N rays in the budget make N / R steps of R rays. There are S steps per ray of a step if R is the square root of
        N / S. The first steps are small, since their duration is unknown.

        Args:
            pace: the run before a step.
        """
        balance = self.config.steps_per_ray
        if not balance:
            return
        if self._measured is None:
            self._measured = pace
            self._most = self.config.num_rays_per_batch if self.recorded else MIN_BATCH
        elif pace.step - self._measured.step >= pace.steps_per_read and pace.seconds > self._measured.seconds:
            found = self._drawn / (pace.seconds - self._measured.seconds)
            known = found if self._rays_per_second is None else self._rays_per_second
            self._rays_per_second = known + SHARE_OF_LAST * (found - known)
            self._most = math.sqrt(pace.budget * self._rays_per_second / balance)
            self._measured, self._drawn = pace, 0

    def request(self, state: State, samples: int | None, progress: float, points: bool) -> Request:
        """Return the request for the next batch: at first one ray per pixel, later the rendering's number.

        Args:
            state: state of the run.
            samples: wanted number of samples; None for a configured number of rays.
            progress: fraction of the budget spent, 0 to 1.
            points: whether the images have sparse depths.
        """
        late = progress >= self.config.train_rays_per_pixel_from
        per_pixel = self.config.rays_per_pixel if late else 1
        rays = self.rays(samples, state.samples_per_ray)
        points = points and progress < POINTS_UNTIL
        return Request(state.step, max(rays // per_pixel, 1), per_pixel, points, progress)

    def rays(self, samples: int | None, samples_per_ray: float) -> int:
        """Return the rays of the next step: for a number of `samples`, if not None, by recent `samples_per_ray`."""
        if samples is None:
            given = self.config.num_rays_per_batch
            wanted = min(max(round(self._most), min(MIN_BATCH, given)), given)
        else:
            wanted = min(max(round(samples / max(samples_per_ray, 0.1)), MIN_BATCH), MAX_BATCH)
        if not self.recorded or not wanted / BATCH_CHANGES <= self._last <= wanted * BATCH_CHANGES:
            self._last = wanted
        self._drawn += self._last
        return self._last
