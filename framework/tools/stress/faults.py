"""Values that are not finite, put where checks on the data would have kept them out.

Photographs are uint8 and hold no NaN, and formats refuse a pose that is not finite (`cameras.check_pose`). But a format
may forget to look, and floating-point inputs may come one day. So pixels are spoiled in the batch, after it was drawn,
and a pose in the data set, after it was read: what is tested is the trainer, the samplers and the kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from framework.data.dataset import Dataset

EVERY = 3
"""Batches of which the first is spoiled: often, but not the ten in a row that end a run."""

Spoil = Callable[[Any, int], Any]
"""From a batch and the step's number to the batch that is learnt from."""


def spoiled_pixel(value: float) -> Spoil:
    """One pixel of every third batch, the first included, shows `value` in all channels.

    So many steps cannot but be dropped (`spoiled_batches`): whoever drops fewer has hidden what was wrong.
    """

    def spoil(batch: Any, step: int) -> Any:
        if step % EVERY:
            return batch
        rgb = batch.rgb.clone()
        rgb.view(-1, 3)[0] = value
        return replace(batch, rgb=rgb)

    return spoil


def spoiled_batches(steps: int) -> int:
    """How many of the first `steps` batches are spoiled."""
    return -(-steps // EVERY)


def spoiled_pose(dataset: Dataset, value: float) -> Dataset:
    """The first camera's pose is `value` throughout."""
    poses = dataset.cameras.camera_to_worlds.clone()
    poses[0] = value
    scene = replace(dataset.scene, camera_to_worlds=poses)
    return replace(dataset, cameras=replace(dataset.cameras, camera_to_worlds=poses), scene=scene)
