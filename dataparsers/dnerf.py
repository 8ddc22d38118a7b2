"""D-NeRF scenes: like NeRF-Synthetic, with a `time` from 0 to 1 in each frame.

Pumarola et al. 2021.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from nerfloom import DataError, ParsedScene
from nerfloom.base.splits import Split
from nerfloom.dataparsers.blender import TRANSFORMS, Blender, has_times


@dataclass(frozen=True)
class DNeRF(Blender):
    """Flags of the dnerf format."""

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return has_times(path / TRANSFORMS)

    def parse(self, path: Path | None, split: Split) -> ParsedScene:
        scene = super().parse(path, split)
        if scene.times is None:
            raise DataError(f"{path}: no frame has a 'time'; for a static scene, use the blender format")
        return scene
