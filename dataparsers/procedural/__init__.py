"""The embedded scene: solids with exact depth and normals, rendered in seconds; used if no data is given.

It is rendered once, in the blender format, to the user's cache folder (NERFLOOM_CACHE, otherwise XDG_CACHE_HOME,
otherwise ~/.cache), and read from there. `--num-scenes` renders many random scenes instead, for methods that learn from
several scenes. `--courtyard True` photographs a courtyard instead, where people walk through (`--distractors`) and
light changes, and `--street N` a street with cars (`--cars`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from torch import Tensor

from nerfloom import DataError, DataParser, ParsedScene
from nerfloom.base.console import say
from nerfloom.base.splits import Split
from nerfloom.base.user_cache import cache_folder
from nerfloom.data.scene import PoseSource
from nerfloom.dataparsers.blender import Blender

VERSION = 1
"""Version of the scene's appearance; increase it with every change, so that old caches are not used."""
MAX_DISTRACTORS = 0.4
"""Maximum share of pixels that distractors can cover on average."""
MAX_HOUSES, MAX_CARS = 1000, 20
"""Maximum number of houses on each side of the street, and of cars near a camera."""
MAX_POSE_ERROR = 0.2
"""Maximum error of a pose, scene units and radians."""


@dataclass(frozen=True)
class Procedural(DataParser):
    """Flags of the embedded scene."""

    size: int = 200
    """Width and height of the images, pixels."""
    num_train: int = 80
    """Number of training images of the embedded scene."""
    moving: bool = False
    """Use the moving variant of the scene."""
    scene_seed: int = 0
    """Seed of the camera positions and of random scenes."""
    num_scenes: int = 1
    """Number of training scenes. With more than one, each is a random arrangement of balls and boxes, and the held-out
    images show further scenes."""
    courtyard: bool = False
    """Use a courtyard: the solids on paving between walls, so that every pixel shows a surface."""
    distractors: float = 0.0
    """Share of the courtyard's training pixels that show people and things found in no other image, from 0 to 0.4. Test
    images are clean."""
    street: int = 0
    """Number of houses on each side of a street with windows, signs and a sky, used instead. 0: no street."""
    cars: int = 0
    """Number of cars near the camera of each training image of the street, at other places in each, with true masks."""
    changing_exposure: bool = False
    """Whether training images of the courtyard or the street differ in exposure, by up to a stop."""
    changing_white_balance: bool = False
    """Whether training images of the courtyard or the street differ in white balance."""
    changing_sun: bool = False
    """Whether the position of the sun differs between training images of the courtyard or the street."""
    pose_error: float = 0.0
    """Error of the street's training poses, as from a device: standard deviation along and about each axis, in scene
    units and radians, from 0 to 0.2. Images and test poses are exact."""
    views_per_scene: int = 12
    """Images of each random scene. In a held-out scene, every fourth is evaluated and the others are sources."""
    placement: Path | None = None
    """dataparser_transforms.json of a run; the street takes its placement. The other scenes are not moved."""

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return False  # there is no data folder

    def parse(self, path: Path | None, split: Split) -> ParsedScene:
        if path is not None:
            raise DataError(f"the embedded scene reads no data; leave out --data {path}")
        if self.size < 1 or self.num_train < 1:
            raise DataError("--size and --num-train must be at least 1")
        if self.scene_seed < 0:
            raise DataError(f"--scene-seed is {self.scene_seed}; it must be at least 0")
        if self.num_scenes < 1 or self.views_per_scene < 4:
            raise DataError("--num-scenes must be at least 1, and --views-per-scene at least 4")
        if self.num_scenes > 1 and self.moving:
            raise DataError("--moving is a variant of the embedded scene: leave out --num-scenes or --moving")
        self._check_scenes()
        folder = self._rendered_folder()
        if self.street:
            from nerfloom.dataparsers.nerfstudio import Nerfstudio

            poses: PoseSource = "device" if self.pose_error else "exact"
            parsed = Nerfstudio(placement=self.placement, poses=poses).parse(folder, split)
            return replace(parsed, appearance_varies=any(self._changing))
        if self.courtyard:
            from nerfloom.dataparsers.procedural.courtyard import HALF

            parsed = Blender(half_size=HALF).parse(folder, split)
            return replace(parsed, appearance_varies=any(self._changing))
        parsed = Blender().parse(folder, split)
        return parsed if self.num_scenes == 1 else _of_many(parsed, split)

    def signed_distance(self, points: Tensor) -> Tensor:
        """Return the distance (N,) from `points` (N, 3) to the nearest surface of the scene at time 0."""
        from nerfloom.dataparsers.procedural.scene import signed_distance

        return signed_distance(points)

    @property
    def _changing(self) -> tuple[bool, bool, bool]:
        return self.changing_exposure, self.changing_white_balance, self.changing_sun

    def _check_scenes(self) -> None:
        """Refuse flags that do not fit the courtyard, the street, or the scene without them."""
        if not 0 <= self.distractors <= MAX_DISTRACTORS:
            raise DataError(f"--distractors is {self.distractors}; it must be from 0 to {MAX_DISTRACTORS}")
        if not 0 <= self.street <= MAX_HOUSES or not 0 <= self.cars <= MAX_CARS:
            raise DataError(f"--street must be from 0 to {MAX_HOUSES}, and --cars from 0 to {MAX_CARS}")
        if self.courtyard and (self.moving or self.num_scenes > 1):
            raise DataError("--courtyard is a scene of its own: leave out --moving and --num-scenes")
        if self.street and (self.moving or self.num_scenes > 1 or self.courtyard):
            raise DataError("--street is a scene of its own: leave out --moving, --num-scenes and --courtyard")
        if not self.courtyard and self.distractors:
            raise DataError("--distractors applies to the courtyard only: add --courtyard True")
        if not self.street and self.cars:
            raise DataError("--cars applies to the street only: add --street 8")
        if not 0 <= self.pose_error <= MAX_POSE_ERROR:
            raise DataError(f"--pose-error is {self.pose_error}; it must be from 0 to {MAX_POSE_ERROR}")
        if not self.street and self.pose_error:
            raise DataError("--pose-error applies to the street only: add --street 8")
        if not (self.courtyard or self.street) and any(self._changing):
            raise DataError("--changing-* apply to the courtyard and the street: add --courtyard True or --street 8")

    def _rendered_folder(self) -> Path:
        """Return the scene's folder; render the scene first if it is not in the cache."""
        kind, count = "moving" if self.moving else "static", str(self.num_train)
        if self.num_scenes > 1:
            kind, count = f"{self.num_scenes}-scenes", str(self.views_per_scene)
        differs = "".join(letter for letter, is_so in zip("ews", self._changing, strict=True) if is_so)
        if self.courtyard:
            kind = f"courtyard{self.distractors:g}{differs}"
        if self.street:
            errors = f"-{self.pose_error:g}off" if self.pose_error else ""
            kind = f"street{self.street}-{self.cars}cars{f'-{differs}' if differs else ''}{errors}"
        folder = cache_folder() / f"procedural-v{VERSION}-{kind}-{self.size}px-{count}-seed{self.scene_seed}"
        if not folder.is_dir():
            say(f"rendering {'the embedded scene' if self.num_scenes == 1 else 'random scenes'} into {folder}")
            try:
                self._render(folder)
            except OSError as error:
                raise DataError(
                    f"cannot write {folder}: {error.strerror}; set NERFLOOM_CACHE to a writable folder"
                ) from error
        return folder

    def _render(self, folder: Path) -> None:
        if self.num_scenes > 1:
            from nerfloom.dataparsers.procedural.random_scenes import write_scenes  # imported only to render

            views = self.views_per_scene
            write_scenes(folder, size=self.size, num_scenes=self.num_scenes, views=views, seed=self.scene_seed)
            return
        counts = {"train": self.num_train, "val": 8, "test": 16}
        if self.street:
            from nerfloom.dataparsers.procedural.photographs import Changing
            from nerfloom.dataparsers.procedural.street import write_street

            write_street(
                folder,
                houses=self.street,
                size=self.size,
                counts=counts,
                cars=self.cars,
                changing=Changing(*self._changing),
                pose_error=self.pose_error,
                seed=self.scene_seed,
            )
            return
        if self.courtyard:
            from nerfloom.dataparsers.procedural.photographs import Changing, write_photographs

            write_photographs(
                folder,
                size=self.size,
                counts=counts,
                distractors=self.distractors,
                changing=Changing(*self._changing),
                seed=self.scene_seed,
            )
            return
        from nerfloom.dataparsers.procedural.views import write_dataset

        write_dataset(folder, size=self.size, counts=counts, moving=self.moving, seed=self.scene_seed)


def _of_many(parsed: ParsedScene, split: Split) -> ParsedScene:
    """Return parsed images with the indices of their scenes."""
    from nerfloom.dataparsers.procedural.random_scenes import what_is_shown

    numbers, given = what_is_shown(parsed.image_paths, split)
    return replace(parsed, scene_indices=numbers, source_images=given)
