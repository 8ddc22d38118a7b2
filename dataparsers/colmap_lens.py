"""COLMAP's camera models as this framework's: intrinsics, sizes, and one lens model for all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dataparsers.colmap_model import SparseCamera
from framework import DataError
from framework.cameras import LENSES

MODELS: dict[str, tuple[str, str]] = {
    "SIMPLE_PINHOLE": ("f", ""),
    "PINHOLE": ("fx fy", ""),
    "SIMPLE_RADIAL": ("f", "k1"),
    "RADIAL": ("f", "k1 k2"),
    "OPENCV": ("fx fy", "k1 k2 p1 p2"),
}
"""COLMAP's model -> its focal lengths, and its coefficients; cx and cy stand between."""


@dataclass(frozen=True)
class Lenses:
    """What M images were taken with."""

    intrinsics: Tensor
    """(M, 4) float64 fx, fy, cx, cy in pixels of an image of `sizes`."""
    sizes: Tensor
    """(M, 2) int64 width and height."""
    model: str
    """A key of `LENSES`."""
    lens: Tensor
    """(M, K) coefficients."""


def lenses_of(cameras: Sequence[SparseCamera], names: Sequence[str], where: str) -> Lenses:
    """The cameras (M) of images called `names`.

    Raises: DataError that names an image with a model that is not known.
    """
    intrinsics = torch.zeros(len(cameras), 4, dtype=torch.float64)
    lens = torch.zeros(len(cameras), len(LENSES["opencv"]))
    for row, (camera, name) in enumerate(zip(cameras, names, strict=True)):
        if camera.model not in MODELS:
            raise DataError(
                f"{where}: image {name!r} has the camera model {camera.model}, which is not known; convert with "
                f"`colmap image_undistorter --image_path IMAGES --input_path {where} --output_path DIR`"
            )
        focal, coefficients = (part.split() for part in MODELS[camera.model])
        fx, fy = camera.params[0], camera.params[len(focal) - 1]
        cx, cy = camera.params[len(focal) : len(focal) + 2]
        intrinsics[row] = torch.tensor([fx, fy, cx, cy], dtype=torch.float64)
        for coefficient, value in zip(coefficients, camera.params[len(focal) + 2 :], strict=True):
            lens[row, LENSES["opencv"].index(coefficient)] = value
    sizes = torch.tensor([[camera.width, camera.height] for camera in cameras])
    return Lenses(intrinsics, sizes, "opencv", lens)
