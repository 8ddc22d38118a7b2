"""Conversion and writing of images and animations, and error maps."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import torch
from torch import Tensor

ERROR_AT_WHITE = 0.25
"""Mean absolute error, of colours in [0, 1], that an error map shows as white."""


def to_uint8(image: Tensor) -> np.ndarray:
    """Convert an `image` (H, W, 3) from [0, 1] to uint8, rounded."""
    return image.detach().clamp(0, 1).mul_(255).round_().to(torch.uint8).cpu().numpy()  # one copy for all steps


def heat(values: Tensor) -> Tensor:
    """Map `values` (H, W) in [0, 1] to colours (H, W, 3) from black over red and yellow to white."""
    return torch.stack([3 * values, 3 * values - 1, 3 * values - 2], dim=-1).clamp(0, 1)


def error_map(prediction: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the mean absolute error of (H, W, 3) uint8 `prediction` and `target` in the colours of `heat`."""
    error = np.abs(prediction.astype(np.float32) - target).mean(-1) / 255
    return to_uint8(heat(torch.from_numpy(error) / ERROR_AT_WHITE))


def write_image(path: Path, image: Tensor) -> None:
    """Write an `image` (H, W, 3) in [0, 1] to `path`, its extension the format, with 8 bits per channel."""
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        iio.imwrite(path, to_uint8(image))
    except BaseException:
        with suppress(OSError):
            path.unlink(missing_ok=True)  # remove an incomplete file
        raise
