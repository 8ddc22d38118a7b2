"""A cache of the most recently used chunks of Gaussians."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence

from nerfloom.splats.gaussians import Gaussians


class ChunkCache:
    """A cache of the most recently used chunks, up to a maximum size.

    Args:
        read: reads a chunk, given its index.
        sizes: size of each chunk in memory, bytes.
        capacity: maximum size of all chunks in memory, bytes, at least the size of each chunk.
    """

    def __init__(self, read: Callable[[int], Gaussians], sizes: Sequence[int], capacity: int) -> None:
        self.read, self.sizes, self.capacity = read, sizes, capacity
        self.size = 0
        """Size of the chunks in memory, bytes."""
        self._held: OrderedDict[int, Gaussians] = OrderedDict()

    def chunks(self, indices: Sequence[int]) -> list[Gaussians]:
        """Return chunks. Missing ones are read, in place of the least recently used.

        Args:
            indices: indices of the chunks; the sum of their sizes does not exceed the capacity.
        """
        for index in indices:
            if index in self._held:
                self._held.move_to_end(index)  # before any chunk is read, so that none of these is removed
        return [self._chunk(index) for index in indices]

    def _chunk(self, index: int) -> Gaussians:
        if index not in self._held:
            while self._held and self.size + self.sizes[index] > self.capacity:
                left, _ = self._held.popitem(last=False)
                self.size -= self.sizes[left]
            self._held[index] = self.read(index)
            self.size += self.sizes[index]
        return self._held[index]
