"""Flags of all commands that open a trained run, a scene in blocks, a file of Gaussians or of levels, or an octree."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from nerfloom.training.run_path import trained_run

if TYPE_CHECKING:
    from nerfloom.training.file_data import DataFormat
    from nerfloom.training.loaded import Loaded

OPENS = "RUN_FOLDER or FILE"
"""Positional argument of such a command, for its help."""


@dataclass(frozen=True, kw_only=True)
class OpenFlags:
    """The trained run or file, and the device that opens it."""

    load_config: Path
    """RUN_FOLDER, its config.yml, a folder above (its newest run), a blocks.yml of ns-blocks or its folder, a file of
    Gaussians (.ply, .spz, .sog, .splat, .ksplat) or of levels (.levels), or an octree (.octree). The flag's
    name may be omitted."""
    load_checkpoint: Path | None = None
    """Checkpoint to load. Default: the newest."""
    data: Path | None = None
    """Folder of the data, if it has moved since training; optional data for a file."""
    device_type: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    """Device to render on."""

    def check(self) -> Path:
        """Check that all files exist, without torch, and return the run's config.yml or the file.

        Raises:
            ConfigError, CheckpointError, DataError: if something is missing.
        """
        return trained_run(self.load_config, self.load_checkpoint, self.data)


@dataclass(frozen=True, kw_only=True)
class RunFlags(OpenFlags):
    """The trained run, the file of Gaussians, or the octree, and how it is shown."""

    up: Literal["x", "y", "z", "-x", "-y", "-z"] | None = None
    """Up axis of a file of Gaussians without data, as in --up=-y. Default: as its run had it, or else z."""
    level_error: float | None = None
    """For a .levels file: largest standard deviation of a merged Gaussian, pixels; 0: merge none. Default: 1."""
    memory_limit: float | None = None
    """Memory for Gaussians, MB (1e6 bytes). For a .levels file: too little makes the level error larger. Default: 2000.
    For a run with Gaussians: the run's setting."""
    eval_rendering: Literal["volume", "surface"] | None = None
    """Rendering of a run with a signed distance. volume: as in training; surface: the colour where a ray first meets
    the surface. Default: the run's setting."""

    def changes(self) -> dict[str, Any]:
        """Return the changed settings of the run or file by name; None keeps its own value."""
        names = ("level_error", "memory_limit", "eval_rendering")
        return {name: getattr(self, name) for name in names}

    def load(self, found: Path, data_format: DataFormat | None = None, **settings: Any) -> Loaded:
        """Load the run or the file that `check` has found.

        Args:
            found: the result of `check`.
            data_format: data format for a file, with its flags; None to detect it.
            settings: further changed settings, as in `changes`.

        Raises:
            ConfigError, CheckpointError, DataError: if it cannot be used.
        """
        from nerfloom.training.load import load

        changes = {**self.changes(), **settings}
        return load(found, self.load_checkpoint, self.device_type, self.data, data_format, self.up, **changes)
