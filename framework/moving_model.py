"""The model of methods that cast rays into a moving scene."""

from __future__ import annotations

from dataclasses import replace
from typing import Generic, TypeVar

from nerfloom.base.step_kind import StepKind
from nerfloom.data.pixels.batch import PixelBatch, thinned
from nerfloom.model import LearnsMotion, Loss
from nerfloom.ray_model import RayModel
from nerfloom.samplers.motion import MotionConfig

MotionConfigT = TypeVar("MotionConfigT", bound=MotionConfig)


class MovingModel(RayModel[MotionConfigT], LearnsMotion, Generic[MotionConfigT], plain=True):
    """A ray model that uses the images' times."""

    def loss(self, batch: PixelBatch, step: int) -> Loss:
        """Return the terms of `losses` on a batch, with a fraction of its transparent pixels (`transparent_share`).

        Args:
            batch: pixels with their true colours.
            step: number of training steps done.
        """
        if not self.scene.moving or batch.alpha is None or self.config.transparent_share == 1:
            return super().loss(batch, step)
        part, kept = thinned(batch, self.config.transparent_share)
        loss = super().loss(part, step)
        # Left-out pixels show only the background, so that their true colour stands for the rendered one.
        return replace(loss, rgb=batch.rgb.index_copy(0, kept, loss.rgb.to(batch.rgb)))

    def step_kind(self, step: int) -> StepKind:
        if self.steps_repeat and self.scene.moving and self.config.transparent_share < 1:
            return StepKind(varies="transparent pixels are left out at random")
        return super().step_kind(step)
