"""The command `ns-bake`: turn a trained field into an octree, which is drawn in real time."""

from __future__ import annotations

import math
import shlex
from dataclasses import dataclass
from pathlib import Path

from nerfloom.base.errors import FlagError
from nerfloom.cli.common import entry_point, make_room, with_run
from nerfloom.cli.flags import read_flags
from nerfloom.cli.run_flags import RunFlags

MIN_RESOLUTION, MAX_RESOLUTION = 16, 1024


@dataclass(frozen=True, kw_only=True)
class BakeFlags(RunFlags):
    """Bake a trained run into an octree (.octree), which ns-eval, ns-render and ns-viewer open like a run.

    The scene must be still; beyond its box there are larger boxes with larger cells. Colours are fitted to the field,
    and then learnt from the photographs. A run of voxels is an octree already: its leaves are kept, and --resolution
    and --fine-tune-seconds have no effect."""

    output_path: Path | None = None
    """File to write, NAME.octree. Default: scene.octree in the run's folder."""
    max_megabytes: float = 30.0
    """Maximum size of the file, millions of bytes. It limits the degree of harmonics first, then the number of
    leaves."""
    resolution: int | None = None
    """Cells along the longest edge of the box of all matter, or of each box of a capture, 16 to 1024. Default: up to
    512, and 256 in a capture; fewer for small images or if half of the leaves would not fit."""
    degree: int | None = None
    """Degree of the harmonics, 0 to 3. Default: 2, 1 or 0, depending on --max-megabytes, or a voxel run's degree."""
    fine_tune_seconds: float = 30.0
    """Time to learn from the photographs; 0: none."""


@entry_point
def main(arguments: list[str]) -> None:
    """Run ns-bake on the `arguments` of the process."""
    flags = read_flags(BakeFlags, "ns-bake", with_run(arguments), takes="RUN_FOLDER")
    _check(flags)
    found = flags.check()
    path = flags.output_path or found.parent / "scene.octree"
    if path.resolve() == found.resolve():
        raise FlagError(f"ns-bake reads {path} and would replace it by a smaller one; name another file: --output-path")
    make_room(path)
    import time

    from nerfloom.base.console import say
    from nerfloom.cameras.scale import write_scale
    from nerfloom.export.bake import Baking, bake
    from nerfloom.octrees.files import write_octree

    start = time.perf_counter()
    loaded = flags.load(found)
    settings = Baking(flags.resolution, 1e6 * flags.max_megabytes, flags.degree, flags.fine_tune_seconds)
    write_octree(path, bake(loaded, settings))
    write_scale(path, loaded.scale)
    size = path.stat().st_size / 1e6
    say(f"{size:.2f} MB after {time.perf_counter() - start:.0f} s: {path}")
    if size > flags.max_megabytes:
        say(f"note: the file is larger than --max-megabytes {flags.max_megabytes:g}, because it compresses less")
    say(f"compare it with its run: ns-eval {shlex.quote(str(path))} --data DIR")


def _check(flags: BakeFlags) -> None:
    if flags.output_path is not None and flags.output_path.suffix.lower() != ".octree":
        raise FlagError(f"--output-path is {flags.output_path}; octrees are written to .octree files")
    if not 0 < flags.max_megabytes < math.inf:
        raise FlagError(f"--max-megabytes is {flags.max_megabytes:g}; it must be more than 0 and finite")
    if flags.resolution is not None and not MIN_RESOLUTION <= flags.resolution <= MAX_RESOLUTION:
        raise FlagError(f"--resolution is {flags.resolution}; it must be from {MIN_RESOLUTION} to {MAX_RESOLUTION}")
    if flags.degree is not None and not 0 <= flags.degree <= 3:
        raise FlagError(f"--degree is {flags.degree}; it must be from 0 to 3")
    if not 0 <= flags.fine_tune_seconds < math.inf:
        raise FlagError(f"--fine-tune-seconds is {flags.fine_tune_seconds:g}; it must be at least 0 and finite")


if __name__ == "__main__":
    main()
