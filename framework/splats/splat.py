"""Gaussians in .splat files: 32 bytes each, one after the other, without a header.

The format is defined by https://github.com/antimatter15/splat (convert.py and main.js):

    position    3 x float32
    scale       3 x float32   standard deviations
    colour      3 x 8 bits    255 (0.5 + DC f) of the coefficient f of degree 0
    opacity     1 x 8 bits    255 sigmoid(logit)
    rotation    4 x 8 bits    128 (q + 1) of w, x, y and z of a unit quaternion

There are no harmonics of higher degrees: colours do not depend on the view.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from nerfloom.base.errors import DataError
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.ply import usable
from nerfloom.splats.stored import as_float32, colors_of_bytes, log_scales_of, logits_of_bytes

ROW = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])
"""Layout of one Gaussian."""


def read_splat(file: Path) -> Gaussians:
    """Read Gaussians from a .splat file, of degree 0.

    Gaussians that are not finite are removed, with a message on the terminal. Opacities of 0 and 1 become 1/1020 and
    1019/1020, the centres of the intervals that round to them; their own logits are infinite.

    Args:
        file: path of the file.

    Raises:
        DataError: if the file cannot be read, is truncated, or is something else.
    """
    try:
        content = file.read_bytes()
    except OSError as error:
        raise DataError(f"cannot read {file}: {error.strerror}") from error
    if not content or len(content) % ROW.itemsize:
        raise DataError(
            f"{file} is not a .splat file, or is truncated: it has {len(content):,} bytes, and each Gaussian has"
            f" {ROW.itemsize}; copy or export it again"
        )
    rows = np.frombuffer(content, ROW)
    gaussians = Gaussians(
        means=as_float32(rows["position"]),
        log_scales=log_scales_of(rows["scale"]),
        rotations=as_float32((rows["rotation"].astype(np.float64) - 128) / 128),
        logits=logits_of_bytes(rows["color"][:, 3]),
        colors=colors_of_bytes(rows["color"][:, :3]),
        harmonics=torch.zeros(len(rows), 3, 0),
    )
    return usable(gaussians, file)
