"""Colours of future batches, read ahead from a file in the file's order.

Which pixels a step draws is a function of (seed, step) alone (`device.seed_step`), so they can be drawn long before.
The pixels of many steps are drawn, sorted, and read from front to back once, in a thread of its own, while training
goes on with those of the steps before. So each batch is what it would be with all pixels in memory, to the bit, however
far is read ahead; a resumed run need not know where an earlier one had read.
"""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from framework.base.device import stream_seed
from framework.data.dataset import Dataset

MOST_STEPS = 64
"""Steps whose pixels are read at once, at most."""
FIRST_STEPS = 4
"""Those of the first reading, for which training waits; each later one is twice as long."""
MARGIN = 1.25
"""Pixels are read for batches this much larger than the last, which may grow meanwhile."""
BYTES = 32
"""Memory that reading a pixel takes, with a reserve: 8 for its number and place, 3 or 4 for its colour, the rest for
what is in work."""
PIECE = 2**16
"""Pixels in work at once."""


@dataclass(frozen=True)
class Block:
    """What was read for some steps."""

    first: int
    """The first step."""
    colors: Tensor
    """(steps, R, C) uint8: what each step draws first."""

    def holds(self, step: int) -> bool:
        """Whether it was read for a step."""
        return self.first <= step < self.first + len(self.colors)


class PixelStream:
    """Reads ahead what training will draw.

    Args:
        dataset: whose pixels lie in a file. `drawn` must not change any more.
        seed: the run's.
    Raises: ValueError where the pixels are in memory.
    """

    def __init__(self, dataset: Dataset, seed: int) -> None:
        if dataset.mapped is None:
            raise ValueError("the data set's pixels are in memory: there is nothing to read ahead")
        self.mapped, self.drawn, self.seed = dataset.mapped, dataset.drawn, seed
        self.total = len(dataset.pixels) if self.drawn is None else len(self.drawn)
        self.capacity = self.mapped.slice // BYTES
        """Pixels that may be read at once."""
        self._reader = ThreadPoolExecutor(1, thread_name_prefix="pixels")
        self._block: Block | None = None
        self._next: Future[Block] | None = None

    def look_up(self, step: int, flat: Tensor) -> Tensor:
        """Stored colours (R, C) uint8 of the pixels `flat` (R,) that step `step` drew, in the order of drawing."""
        if self._block is None or not self._block.holds(step):
            self._block = self._read(step, len(flat))
        ready = self._block.colors[step - self._block.first]
        if len(flat) <= len(ready):
            return ready[: len(flat)]
        return torch.cat([ready, self.mapped.look_up(flat[len(ready) :])])

    def _read(self, step: int, count: int) -> Block:
        """The block of a step that draws `count` pixels; the one after it is begun."""
        block = None if self._next is None else self._next.result()
        if block is None or not block.holds(step):
            block = self._begin(step, FIRST_STEPS, count).result()
        steps = len(block.colors)
        self._next = self._begin(block.first + steps, min(2 * steps, MOST_STEPS), round(MARGIN * count))
        return block

    def _begin(self, first: int, steps: int, count: int) -> Future[Block]:
        """Read for so many steps from `first` on, or for as many as fit, in the thread."""
        count = max(min(count, self.capacity), 1)
        return self._reader.submit(self.read, first, max(min(steps, self.capacity // count), 1), count)

    def read(self, first: int, steps: int, count: int) -> Block:
        """What the steps first .. first + steps - 1 draw, if they draw `count` pixels each.

        A number holds a pixel's rank among those worth drawing and, in its low bits, whose it is; so one sort in place
        tells both what to read next and where to put it.
        """
        places = steps * count
        bits, generator = places.bit_length(), torch.Generator()
        numbers = np.empty(places, np.int64)
        for index in range(steps):
            generator.manual_seed(stream_seed(self.seed, first + index))
            part = numbers[index * count : (index + 1) * count]
            part[:] = torch.randint(self.total, (count,), generator=generator).numpy()
        numbers <<= bits
        numbers |= np.arange(places)
        numbers.sort()
        colors = np.empty((places, self.mapped.pixels.shape[1]), np.uint8)
        for start in range(0, places, PIECE):
            piece = numbers[start : start + PIECE]
            flat = piece >> bits
            if self.drawn is not None:
                flat = self.drawn.at(torch.from_numpy(flat)).numpy()
            colors[piece & ((1 << bits) - 1)] = self.mapped.take(flat)
        return Block(first, torch.from_numpy(colors).view(steps, count, -1))
