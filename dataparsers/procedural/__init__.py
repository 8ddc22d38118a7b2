"""The embedded scene: solids with exact depth and normals, rendered in seconds, used if no data is given.

It is rendered once, in the blender format, to the user's cache folder (NERFLOOM_CACHE, else XDG_CACHE_HOME, else
~/.cache), and read from there.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from dataparsers.blender import Blender
from framework import DataError, DataParser, ParsedScene
from framework.base.console import say, track
from framework.base.user_cache import cache_folder
from framework.data.dataset import Split

VERSION = 1
"""Version of the scene's appearance; raised whenever it changes, so that old caches are not used."""


@dataclass(frozen=True)
class Procedural(DataParser):
    """Flags of the embedded scene."""

    size: int = 200
    """Width and height of the images, pixels."""
    num_train: int = 80
    """Number of training images."""
    moving: bool = False
    """Use the moving variant of the scene."""
    scene_seed: int = 0
    """Seed of the camera positions."""

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return False  # it has no data folder

    def parse(self, path: Path | None, split: Split) -> ParsedScene:
        if path is not None:
            raise DataError(f"the embedded scene reads no data; leave out --data {path}")
        if self.size < 1 or self.num_train < 1:
            raise DataError("--size and --num-train must be at least 1")
        return Blender().parse(self._rendered_folder(), split)

    def signed_distance(self, points: Tensor) -> Tensor:
        """Return the distance (N,) from `points` (N, 3) to the nearest surface of the scene at time 0."""
        from dataparsers.procedural.scene import signed_distance

        return signed_distance(points)

    def _rendered_folder(self) -> Path:
        """Return the scene's folder; render the scene first if it is not in the cache."""
        from dataparsers.procedural.views import write_dataset  # only if it must be rendered

        kind = "moving" if self.moving else "static"
        folder = cache_folder() / f"procedural-v{VERSION}-{kind}-{self.size}px-{self.num_train}-seed{self.scene_seed}"
        if not folder.is_dir():
            say(f"rendering the embedded scene into {folder}")
            counts = {"train": self.num_train, "val": 8, "test": 16}
            try:
                write_dataset(
                    folder, size=self.size, counts=counts, moving=self.moving, seed=self.scene_seed, progress=track
                )
            except OSError as error:
                raise DataError(
                    f"cannot write {folder}: {error.strerror}; set NERFLOOM_CACHE to a writable folder"
                ) from error
        return folder
