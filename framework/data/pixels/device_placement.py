"""Location of training images: on the device as bytes, or in the machine's memory if they do not fit."""

from __future__ import annotations

import torch

from nerfloom.base.device import free_memory
from nerfloom.data.dataset import Dataset
from nerfloom.data.pixels.cache import MB

MAX_MEMORY_SHARE = 0.5
"""Maximum fraction of a device's free memory for images; the rest is for the model and its steps."""


def on_device(dataset: Dataset, device: torch.device) -> tuple[Dataset, str | None]:
    """Move training images to a device in their stored form, 8 bits a channel; batches are converted when drawn.

    Args:
        dataset: the images, in the machine's memory or in a file.
        device: the training device.

    Returns:
        The data set, and a line about the location of its pixels; None on the CPU. Pixels that need more than
        `MAX_MEMORY_SHARE` of the device's free memory stay where they are; their batches are drawn on the CPU.
    """
    free, size = free_memory(device), sum(values.nbytes for values in _moved(dataset))
    fits = dataset.mapped is None and size <= MAX_MEMORY_SHARE * free
    moved = dataset.to(device, with_pixels=fits)
    if device.type == "cpu":
        return moved, None
    if fits:
        return moved, f"images: {size / MB:,.0f} MB on {device.type}, 8 bits a channel"
    if dataset.mapped is not None:
        return moved, "images: in a file; batches are read ahead and copied"
    there = f"{device.type} has {free / MB:,.0f} MB free"
    return moved, f"images: {size / MB:,.0f} MB stay in the machine's memory ({there}); batches are copied"


def _moved(dataset: Dataset) -> list[torch.Tensor]:
    """Return the large tensors that move to a device together with the pixels."""
    drawn = None if dataset.drawn is None else dataset.drawn.every
    return [dataset.pixels, *([] if drawn is None else [drawn])]
