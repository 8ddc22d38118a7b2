"""Conversion of COLMAP's cameras: intrinsics, sizes, and one lens model for all."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from nerfloom import DataError
from nerfloom.cameras.colmap import PARAMETERS, Intrinsics, from_colmap
from nerfloom.dataparsers.colmap_model import SparseCamera
from nerfloom.dataparsers.posed_images import Lenses
from nerfloom.geometry.lenses import LENSES


def lenses_of(cameras: Sequence[SparseCamera], names: Sequence[str], where: str) -> Lenses:
    """Convert M `cameras` of images `names` to one lens model; `where` is their folder, for messages.

    Raises:
        DataError: if the camera model of an image is not supported, or cannot be combined with another's.
    """
    converted: list[Intrinsics] = []
    for camera, name in zip(cameras, names, strict=True):
        try:
            converted.append(from_colmap(camera.model, camera.params, camera.width, camera.height))
        except DataError as error:
            command = "" if camera.model in PARAMETERS else f", for example with: {_command(where)}"
            raise DataError(f"{where}: image {name!r}: {error}{command}") from error
    models = [camera.model for camera in converted]
    # A pinhole camera is an opencv camera without distortion.
    model = next((kind for kind in models if kind != "pinhole"), "pinhole")
    lens = torch.zeros(len(converted), len(LENSES[model]))
    for row, current in enumerate(converted):
        if current.model not in (model, "pinhole") or (model == "fisheye" and current.model == "pinhole"):
            raise DataError(
                f"{where}: image {names[row]!r} has a camera of the model {current.model}, and image "
                f"{names[models.index(model)]!r} one of {model}; convert the images to one model: {_command(where)}"
            )
        lens[row, : len(current.lens)] = torch.tensor(current.lens)
    intrinsics = torch.tensor([[c.fx, c.fy, c.cx, c.cy] for c in converted], dtype=torch.float64)
    return Lenses(intrinsics, torch.tensor([[c.width, c.height] for c in cameras]), model, lens)


def _command(where: str) -> str:
    return f"colmap image_undistorter --image_path IMAGES --input_path {where} --output_path UNDISTORTED"
