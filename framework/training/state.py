"""State of a run besides its parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from nerfloom.base.processes import gathered, processes
from nerfloom.evaluation.metrics import MAX_PSNR
from nerfloom.training.curve import Entry

FIRST_SAMPLES_PER_RAY = 256.0
"""Initial estimate of samples per ray, if the batch size depends on it."""


@dataclass
class State:
    """State of a run besides its parameters, saved in every checkpoint."""

    step: int = 0
    """Number of training steps done."""
    seconds: float = 0.0
    """Seconds of training, without evaluation and saving."""
    rays: int = 0
    """Number of rays trained on."""
    skipped: int = 0
    """Number of steps dropped because a loss or gradient was not finite."""
    samples_per_ray: float = FIRST_SAMPLES_PER_RAY
    """Running mean of samples per ray."""
    train_mse: float = 1.0
    """Running mean of the batches' squared error, without bias correction."""
    curve: tuple[Entry, ...] = ()
    """Evaluations of all held-out images."""
    looks: tuple[Entry, ...] = ()
    """Evaluations of a few held-out images."""

    def newest_held_out(self, first_step: int) -> tuple[float, float] | None:
        """Return the PSNR of the newest evaluation of held-out images, dB, and the seconds of training since.

        Args:
            first_step: ignore evaluations up to this step, since an earlier process made them.

        Returns:
            PSNR and seconds; None if there is no such evaluation.
        """
        newest = max((*self.curve[-1:], *self.looks[-1:]), key=lambda entry: entry[1], default=None)
        if newest is None or newest[1] <= first_step:
            return None
        return newest[2], self.seconds - newest[0]

    @property
    def train_psnr(self) -> float:
        """PSNR of the batches, dB, from the running mean of their error."""
        return min(-10 * float(torch.tensor(max(self.train_mse, 1e-12)).log10()), MAX_PSNR)

    def account(self, rays: int, samples_per_ray: float, seconds: float) -> None:
        """Count a step of `rays` in all processes that took `seconds`; `samples_per_ray` is NaN if not known yet."""
        self.step += 1
        self.seconds += seconds
        self.rays += rays
        self.learn_samples_per_ray(samples_per_ray)

    def learn_samples_per_ray(self, found: float) -> None:
        """Update the running mean with a step's samples per ray; no effect if `found` is NaN."""
        if not math.isnan(found):
            self.samples_per_ray += 0.2 * (found - self.samples_per_ray)


def agree(state: State, received: Sequence[int]) -> Sequence[int]:
    """Copy from the first process the values that decide on the next step: clock, samples per ray and last evaluation.

    Args:
        state: the state of this process, changed in place.
        received: numbers of the signals that this process has received.

    Returns:
        The first signal of each process that received one; `received` itself if there is one process.

    Raises:
        LostProcessError: if another process has ended.
    """
    if processes().count == 1:
        return received
    psnr = state.curve[-1][2] if state.curve else -math.inf
    rows = gathered([state.seconds, state.samples_per_ray, psnr, next(iter(received), 0)])
    if not processes().first:
        state.seconds, state.samples_per_ray, psnr, _ = rows[0]
        state.curve = ((state.seconds, state.step, psnr),)
    return [int(row[-1]) for row in rows if row[-1]]
