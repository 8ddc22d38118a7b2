"""Ring: images taken all around, named by their angle in degrees, as 030.png; nothing but the images is needed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import torch

from nerfloom import Cameras, DataError, DataParser, ParsedScene
from nerfloom.data.image_files import image_size


@dataclass(frozen=True)
class Ring(DataParser):
    """Images from a circle around the origin; every fourth is held out."""

    interface: ClassVar[int] = 2
    distance: float = 4.0
    """Radius of the circle, scene units."""
    camera_angle: float = 40.0
    """Horizontal field of view, degrees."""

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return bool(list(path.glob("[0-9][0-9][0-9].png")))

    def parse(self, path: Path | None, split: Literal["train", "val", "test"]) -> ParsedScene:
        if path is None or not (images := sorted(path.glob("[0-9][0-9][0-9].png"))):
            raise DataError(f"{path} has no image named by its angle, as 030.png")
        chosen = [image for i, image in enumerate(images) if (i % 4 == 0) == (split != "train")]
        width, height = image_size(chosen)
        angles = torch.tensor([math.radians(int(image.stem)) for image in chosen])
        cos, sin, zero = angles.cos(), angles.sin(), torch.zeros(len(chosen))
        columns = [[-sin, cos, zero], [zero, zero, zero + 1], [cos, sin, zero]]  # right, up, backwards
        columns.append([self.distance * cos, self.distance * sin, zero])
        poses = torch.stack([torch.stack(column, -1) for column in columns], -1)
        focal = torch.full((len(chosen),), width / 2 / math.tan(math.radians(self.camera_angle) / 2))
        ones = torch.ones(len(chosen))
        sizes = [torch.full((len(chosen),), size) for size in (width, height)]
        cameras = Cameras(poses, focal, focal, ones * width / 2, ones * height / 2, *sizes)
        box = torch.tensor([[-1.5] * 3, [1.5] * 3])
        return ParsedScene(tuple(chosen), cameras, box, near=self.distance - 2.6, far=self.distance + 2.6)
