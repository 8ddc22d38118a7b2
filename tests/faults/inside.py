"""ns-train in a faulty world: python -m tests.faults.inside WORLD ARGUMENTS...

Each fault prints `INJECTED` on standard error when it happens.
"""

import sys
import time
from itertools import count, cycle

import numpy as np

from nerfloom.cli.train import main
from nerfloom.data.pixels.memory_mapped import MappedPixels

INJECTED = "injected"
DAY = 86_400.0
READS = 2
"""Number of reads of the thread that reads pixels ahead, before it dies."""
MAX_FILE = 20_000
"""Bytes. A checkpoint needs more, and nothing else does."""


def say_so() -> None:
    print(INJECTED, file=sys.stderr, flush=True)


def clock_jumps() -> None:
    """Somebody sets the clock a day back, two days on, and so forth, each time that it is looked at."""
    true_time, days = time.time, cycle((-DAY, DAY, -400 * DAY, 0.0))
    time.time = lambda: true_time() + next(days)
    say_so()


def full_disk() -> None:
    """No file may grow beyond a size: the system itself refuses to write more."""
    import resource

    sys.dont_write_bytecode = True  # Python may keep half of a compiled file, which ends every later import of it
    resource.setrlimit(resource.RLIMIT_FSIZE, (MAX_FILE, MAX_FILE))
    say_so()


def dying_reader() -> None:
    """A thread that reads pixels runs out of memory."""
    take, reads = MappedPixels.take, count()

    def dying(self: MappedPixels, flat: np.ndarray) -> np.ndarray:
        if next(reads) == READS:
            say_so()
            raise MemoryError("no memory")
        return take(self, flat)

    MappedPixels.take = dying  # type: ignore[method-assign]


WORLDS = {"clock jumps": clock_jumps, "full disk": full_disk, "dying reader": dying_reader}

if __name__ == "__main__":
    WORLDS[sys.argv.pop(1)]()
    main()
