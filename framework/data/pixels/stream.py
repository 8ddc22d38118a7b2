"""Colours of future batches, read ahead from a file in the file's order.

The pixels of a step depend only on seed, step and process (`device.seed_step`), so they can be drawn long before the
step. A thread draws and sorts the pixels of many steps and reads them from front to back, while training continues with
earlier steps. Each batch has the same bits as with all pixels in memory, however far ahead the thread reads. A resumed
run does not depend on what an earlier run had read.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nerfloom.base.device import stream_seed
from nerfloom.base.processes import processes
from nerfloom.data.dataset import Dataset

MAX_STEPS = 64
"""Maximum number of steps in one block of reads."""
FIRST_STEPS = 4
"""Number of steps of the first block; training waits for it. Each later block has twice as many."""
MARGIN = 1.25
"""Ratio of the pixels read per step to the pixels of the last batch, because batches may grow."""
BYTES = 32
"""Memory per pixel read, bytes: 8 for number and position, 3 or 4 for the colour, the rest for temporary arrays."""
CHUNK = 2**16
"""Number of pixels processed at once."""


@dataclass(frozen=True)
class Block:
    """The colours of several steps."""

    first: int
    """First step."""
    colors: Tensor
    """(steps, R, C) uint8 colours of the first R pixels of each step."""

    def holds(self, step: int) -> bool:
        """Return whether the block contains step `step`."""
        return self.first <= step < self.first + len(self.colors)


class PixelStream:
    """Reads the colours that training will draw.

    Args:
        dataset: a data set with its pixels in a file. `drawn` must not change afterwards.
        seed: the run's seed.

    Raises:
        ValueError: if the pixels are in memory.
    """

    def __init__(self, dataset: Dataset, seed: int) -> None:
        if dataset.mapped is None:
            raise ValueError("the data set's pixels are in memory, so they cannot be read ahead")
        self.mapped, self.drawn, self.seed = dataset.mapped, dataset.drawn, seed
        self.total = len(dataset.pixels) if self.drawn is None else len(self.drawn)
        self.capacity = self.mapped.slice // BYTES
        """Maximum number of pixels read together."""
        self._reader = ThreadPoolExecutor(1, thread_name_prefix="pixels")
        self._block: Block | None = None
        self._next: Future[Block] | None = None

    def look_up(self, step: int, flat: Tensor) -> Tensor:
        """Return the stored colours of the pixels drawn in a step.

        Args:
            step: the step's number.
            flat: (R,) numbers of the pixels, in the order of drawing.

        Returns:
            (R, C) uint8.
        """
        if self._block is None or not self._block.holds(step):
            self._block = self._read(step, len(flat))
        ready = self._block.colors[step - self._block.first]
        if len(flat) <= len(ready):
            return ready[: len(flat)]
        return torch.cat([ready, self.mapped.look_up(flat[len(ready) :])])

    def _read(self, step: int, count: int) -> Block:
        """Return the block of a step that draws `count` pixels, and start reading the next block."""
        block = None if self._next is None else self._next.result()
        if block is None or not block.holds(step):
            block = self._begin(step, FIRST_STEPS, count).result()
        steps = len(block.colors)
        self._next = self._begin(block.first + steps, min(2 * steps, MAX_STEPS), round(MARGIN * count))
        return block

    def _begin(self, first: int, steps: int, count: int) -> Future[Block]:
        """Start reading a block of `steps` steps in the thread, or of fewer if they do not fit."""
        count = max(min(count, self.capacity), 1)
        return self._reader.submit(self.read, first, max(min(steps, self.capacity // count), 1), count)

    def read(self, first: int, steps: int, count: int) -> Block:
        """Return the colours of the pixels of several steps.

        An integer holds a pixel's rank in `drawn` and, in its low bits, the position of its colour in the block. One
        in-place sort then gives both the reading order and the positions.

        Args:
            first: the first step.
            steps: number of steps.
            count: number of pixels per step.
        """
        total = steps * count
        bits, generator = total.bit_length(), torch.Generator()
        numbers = np.empty(total, np.int64)
        for index in range(steps):
            generator.manual_seed(stream_seed(self.seed, first + index, processes().rank))
            part = numbers[index * count : (index + 1) * count]
            part[:] = torch.randint(self.total, (count,), generator=generator).numpy()
        numbers <<= bits
        numbers |= np.arange(total)
        numbers.sort()
        colors = np.empty((total, self.mapped.pixels.shape[1]), np.uint8)
        for start in range(0, total, CHUNK):
            chunk = numbers[start : start + CHUNK]
            flat = chunk >> bits
            if self.drawn is not None:
                flat = self.drawn.at(torch.from_numpy(flat)).numpy()
            colors[chunk & ((1 << bits) - 1)] = self.mapped.take(flat)
        return Block(first, torch.from_numpy(colors).view(steps, count, -1))
