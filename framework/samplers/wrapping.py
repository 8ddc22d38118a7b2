"""Samplers that change the samples of another one."""

from __future__ import annotations

from torch import Tensor

from nerfloom.base.step_kind import StepKind
from nerfloom.fields.base import DensityFunction
from nerfloom.geometry.rays import Samples
from nerfloom.samplers.base import Sampler


class WrappingSampler(Sampler):
    """A sampler that updates another `sampler`, and learns as it does. Subclasses change its samples."""

    def __init__(self, sampler: Sampler) -> None:
        super().__init__()
        self.sampler, self.samples_per_step = sampler, sampler.samples_per_step
        self.has_coarse_level, self.learns_from_weights = sampler.has_coarse_level, sampler.learns_from_weights
        self.carries_gradients = sampler.carries_gradients

    def update(self, step: int, density: DensityFunction) -> None:
        self.sampler.update(step, density)

    def step_kind(self, step: int) -> StepKind:
        return self.sampler.step_kind(step)

    def read_counts(self) -> None:
        self.sampler.read_counts()

    def loss(self, samples: Samples, weights: Tensor) -> Tensor | None:
        return self.sampler.loss(samples, weights)
