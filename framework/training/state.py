"""The state of a run in training, besides its parameters."""

from __future__ import annotations

from dataclasses import dataclass

from framework.training.curve import Entry

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
