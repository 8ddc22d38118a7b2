"""Polycam's raw exports: keyframes/corrected_images or keyframes/images, with a JSON file per camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import torch

from nerfloom import DataError, ParsedScene
from nerfloom.base.json_files import number, read_object
from nerfloom.base.splits import Split
from nerfloom.data.depths import DEPTH_SUFFIXES
from nerfloom.data.names_on_disk import on_disk
from nerfloom.data.scene import PoseSource
from nerfloom.dataparsers.captured import captured_scene, has_transforms, image_sizes, sizes_of
from nerfloom.dataparsers.placing import from_original
from nerfloom.dataparsers.posed_images import Captured, PosedImages
from nerfloom.dataparsers.reading import rigid, side_or_none

CAMERAS = (("corrected_cameras", "corrected_images"), ("cameras", "images"))
"""Folders of cameras and images in `keyframes`; those refined by Polycam come first."""
Z_UP = torch.tensor([[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""Rotation from Polycam's axes (y up) to the scene's (z up), as in nerfstudio."""


@dataclass(frozen=True)
class Polycam(Captured):
    """Flags of the polycam format."""

    poses: PoseSource = "device"
    depth_unit_scale_factor: float = 0.001
    """Metres per unit of a stored depth."""

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return any(_is_pair(path, *pair) for pair in CAMERAS) and not has_transforms(path)

    def parse(self, path: Path | None, split: Split) -> ParsedScene:
        if path is None:
            raise DataError("the polycam format needs a folder: --data DIR")
        if not self.depth_unit_scale_factor > 0:
            raise DataError(f"--depth-unit-scale-factor is {self.depth_unit_scale_factor}; it must be above zero")
        pairs = [pair for pair in CAMERAS if _is_pair(path, *pair)]
        if not pairs:
            raise DataError(f"{path} lacks keyframes/cameras or keyframes/images; export Polycam's raw data")
        images = _posed_images(path / "keyframes", *pairs[0], split)
        scene = captured_scene(self, images, split, applied=(Z_UP, 1.0))
        return replace(from_original(scene, Z_UP), depth_unit=self.depth_unit_scale_factor)


def _is_pair(path: Path, cameras: str, images: str) -> bool:
    return (path / "keyframes" / cameras).is_dir() and (path / "keyframes" / images).is_dir()


def _posed_images(folder: Path, cameras: str, images: str, split: Split) -> PosedImages:
    files = sorted((folder / cameras).glob("*.json"))
    if not files:
        raise DataError(f"{folder / cameras} has no cameras (.json); export Polycam's raw data again")
    stems = [file.stem for file in files]
    paths = on_disk(folder, [f"{images}/{stem}" for stem in stems], quiet=split != "train")
    poses, intrinsics, stated = [], [], []
    for file in files:
        content = read_object(file)
        rows = [[number(content.get(f"t_{r}{c}"), f"t_{r}{c}", str(file)) for c in range(4)] for r in range(3)]
        poses.append(Z_UP.double() @ rigid(rows, str(file), str(file)))
        focal = [number(content.get(key), key, str(file), positive=True) for key in ("fx", "fy")]
        intrinsics.append(focal + [number(content.get(key), key, str(file)) for key in ("cx", "cy")])
        stated.append([side_or_none(content.get(key), key, str(file)) for key in ("width", "height")])
    depths = on_disk(folder, [f"depth/{stem}" for stem in stems], "depth images", DEPTH_SUFFIXES, quiet=True, shared=2)
    known = tuple(file if file.is_file() else None for file in depths)
    return PosedImages(
        folder=folder,
        paths=paths,
        names=tuple(stems),
        poses=torch.stack(poses),
        intrinsics=torch.tensor(intrinsics, dtype=torch.float64),
        sizes=sizes_of(stated, lambda: image_sizes(paths)),
        depths=known if any(known) else None,
    )
