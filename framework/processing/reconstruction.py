"""State of a reconstruction in progress: its flags, its files and the time of each stage."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from nerfloom.processing.settings import ColmapFlags
from nerfloom.processing.unfinished import unfinished
from nerfloom.processing.worker import run_in_child


@dataclass(frozen=True)
class Reconstruction:
    """A reconstruction in progress."""

    flags: ColmapFlags
    """The user's flags."""
    ordered: bool
    """Whether the images were taken one after the other, in the order of their names."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Seconds spent in each stage so far."""

    @property
    def work(self) -> Path:
        """Folder of unfinished files."""
        return unfinished(self.flags.output_dir)

    @property
    def images(self) -> Path:
        """Folder of the images that are reconstructed."""
        return self.work / "images" if self.flags.undistort else self.flags.output_dir / "images"

    @property
    def stretched(self) -> Path:
        """Folder of images with stretched brightness; it exists if some images have a small range."""
        return self.work / "stretched"

    @property
    def database(self) -> Path:
        """COLMAP's database."""
        return self.work / "database.db"

    @property
    def log(self) -> Path | None:
        """File for COLMAP's output; None leaves it on the terminal."""
        return None if self.flags.verbose else self.flags.output_dir / "colmap" / "log.txt"

    def run(
        self,
        work: Callable[..., Any],
        arguments: tuple,
        title: str,
        total: int = 1,
        count: Callable[[], int] | None = None,
        unit: str | None = None,
    ) -> Any:
        """Run a function in a child process with this reconstruction's log.

        Args:
            work, arguments, title, total, count, unit: as in `run_in_child`.
        """
        return run_in_child(work, arguments, title, total, self.log, count, unit)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Add the duration of a `with` block to a `stage`."""
        start = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start
