"""Flags of every `ns-export`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nerfloom.cli.run_flags import RunFlags


@dataclass(frozen=True, kw_only=True)
class ExportFlags(RunFlags):
    """Flags of every export."""

    output_dir: Path
    """Folder to write to."""
