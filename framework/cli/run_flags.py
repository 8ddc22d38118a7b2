"""Flags of every command that opens a trained run, a file of Gaussians, or an octree."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from nerfloom.training.run_path import trained_run

if TYPE_CHECKING:
    from nerfloom.training.loaded import Loaded

OPENS = "RUN_FOLDER or FILE"
"""Positional argument of such a command, for its help."""


@dataclass(frozen=True, kw_only=True)
class RunFlags:
    """The trained run, the file of Gaussians, or the octree."""

    load_config: Path
    """RUN_FOLDER, its config.yml, a folder above (its newest run), a file of Gaussians (.ply, .spz, .splat), or an
    octree (.octree). The flag's name may be omitted."""
    load_checkpoint: Path | None = None
    """Checkpoint to load. Default: the newest."""
    data: Path | None = None
    """Folder of the data, if it has moved since training; optional data for a file."""
    up: Literal["x", "y", "z", "-x", "-y", "-z"] | None = None
    """Up axis of a file of Gaussians without data, as in --up=-y. Default: z."""
    device_type: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    """Device to render on."""
    eval_rendering: Literal["volume", "surface"] | None = None
    """Rendering of a run with a signed distance. volume: as in training; surface: the colour where a ray first meets
    the surface. Default: the run's setting."""

    def check(self) -> Path:
        """Check that all files exist, without torch, and return the run's config.yml or the file.

        Raises:
            ConfigError, CheckpointError, DataError: if something is missing.
        """
        return trained_run(self.load_config, self.load_checkpoint, self.data)

    def load(self, found: Path, **others: Any) -> Loaded:
        """Load the run or the file that `check` has found.

        Args:
            found: the result of `check`.
            others: further arguments of `nerfloom.training.load.load`.

        Raises:
            ConfigError, CheckpointError, DataError: if it cannot be used.
        """
        from nerfloom.training.load import load

        given = self.load_checkpoint, self.device_type, self.data
        return load(found, *given, eval_rendering=self.eval_rendering, up=self.up, **others)
