"""Flags of every `ns-export`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class ExportFlags:
    """Flags of every export."""

    load_config: Path
    """RUN_FOLDER, its config.yml, or a folder above (its newest run); the flag's name may be left out."""
    output_dir: Path
    """Folder to write to."""
    load_checkpoint: Path | None = None
    """Checkpoint to load; the newest if not given."""
    data: Path | None = None
    """Folder of the data, if it has moved since training."""
    device_type: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    """Device to render on."""
