"""COLMAP's camera models as this framework's: intrinsics, sizes, and one lens model for all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dataparsers.colmap_model import SparseCamera
from framework import DataError
from framework.cameras.cameras import LENSES
from framework.cameras.colmap import PARAMETERS, Intrinsics, from_colmap


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
    """The cameras (M) of images called `names`, of a reconstruction in the folder `where`.

    Raises: DataError that names an image whose camera model is not known, or cannot be mixed with another's.
    """
    found: list[Intrinsics] = []
    for camera, name in zip(cameras, names, strict=True):
        try:
            found.append(from_colmap(camera.model, camera.params, camera.width, camera.height))
        except DataError as error:
            command = "" if camera.model in PARAMETERS else f", as in: {_command(where)}"
            raise DataError(f"{where}: image {name!r}: {error}{command}") from error
    models = [camera.model for camera in found]
    # Without distortion an opencv camera is a pinhole, and the other way round.
    model = next((kind for kind in models if kind != "pinhole"), "pinhole")
    lens = torch.zeros(len(found), len(LENSES[model]))
    for row, own in enumerate(found):
        if own.model not in (model, "pinhole") or (model == "fisheye" and own.model == "pinhole"):
            raise DataError(
                f"{where}: image {names[row]!r} has a {own.model} camera and image {names[models.index(model)]!r} a "
                f"{model} one, which one scene cannot mix; convert the images: {_command(where)}"
            )
        lens[row, : len(own.lens)] = torch.tensor(own.lens)
    intrinsics = torch.tensor([[c.fx, c.fy, c.cx, c.cy] for c in found], dtype=torch.float64)
    return Lenses(intrinsics, torch.tensor([[c.width, c.height] for c in cameras]), model, lens)


def _command(where: str) -> str:
    return f"colmap image_undistorter --image_path IMAGES --input_path {where} --output_path UNDISTORTED"
