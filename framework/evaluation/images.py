"""Pictures: renders, comparisons and animations."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import torch
from torch import Tensor

ERROR_AT_WHITE = 0.25
"""Mean absolute error that an error map shows as white."""


def to_uint8(image: Tensor) -> np.ndarray:
    """(H, W, 3) in [0, 1] to uint8, rounded."""
    return (image.detach().clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()


def heat(values: Tensor) -> Tensor:
    """(H, W) in [0, 1] as black, red, yellow, white (H, W, 3)."""
    return torch.stack([3 * values, 3 * values - 1, 3 * values - 2], dim=-1).clamp(0, 1)


def error_map(prediction: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The mean absolute error over channels of two pictures (H, W, 3) uint8 as `heat` (H, W, 3) uint8."""
    wrong = np.abs(prediction.astype(np.float32) - target).mean(-1) / 255
    return to_uint8(heat(torch.from_numpy(wrong) / ERROR_AT_WHITE))


def write_image(path: Path, image: Tensor) -> None:
    """(H, W, 3) in [0, 1] as an 8-bit PNG; makes the folder."""
    _write(path, to_uint8(image))


def write_animation(path: Path, frames: Sequence[Tensor], fps: float) -> None:
    """(H, W, 3) frames in [0, 1] as an endless animation; the ending (.gif, .webp, .png) chooses the format."""
    _write(path, np.stack([to_uint8(frame) for frame in frames]), duration=1000 / fps, loop=0)


def _write(path: Path, pixels: np.ndarray, **options: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        iio.imwrite(path, pixels, **options)
    except BaseException:
        with suppress(OSError):
            path.unlink(missing_ok=True)  # half a picture is none
        raise
