"""Injection of non-finite values behind the checks that would refuse them.

Images are uint8 and contain no NaN, and formats refuse poses that are not finite (`cameras.check_pose`). But a format
may lack the check, and floating-point images may be supported later. So pixels are spoiled in the batch after it is
drawn, and a pose in the data set after it is read. This tests the trainer, the samplers and the kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from nerfloom.data.dataset import Dataset

EVERY = 3
"""Distance between spoiled batches; more than one, because ten consecutive non-finite steps end a run."""

Spoil = Callable[[Any, int], Any]
"""Function from a batch and the step number to the spoiled batch."""


def spoiled_pixel(value: float) -> Spoil:
    """Return a function that sets all channels of a pixel to `value` in every third batch, from the first.

    Minimum number of dropped steps (`spoiled_batches`); a method that drops fewer hides the fault.
    """

    def spoil(batch: Any, step: int) -> Any:
        if step % EVERY:
            return batch
        rgb = batch.rgb.clone()
        rgb.view(-1, 3)[0] = value
        return replace(batch, rgb=rgb)

    return spoil


def spoiled_batches(steps: int) -> int:
    """Return the number of spoiled batches among the first `steps` batches."""
    return -(-steps // EVERY)


def spoiled_pose(dataset: Dataset, value: float) -> Dataset:
    """Set all entries of the first camera's pose in `dataset` to `value`."""
    poses = dataset.cameras.camera_to_worlds.clone()
    poses[0] = value
    scene = replace(dataset.scene, camera_to_worlds=poses)
    return replace(dataset, cameras=replace(dataset.cameras, camera_to_worlds=poses), scene=scene)
