"""A video becomes photographs: the sharpest frame of each of many equal intervals."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from framework.base.console import say, track
from framework.base.errors import DataError
from framework.base.extras import missing
from framework.tools.processing.photographs import save


def write_frames(video: Path, folder: Path, target: int) -> list[Path]:
    """Write about `target` frames of a video as folder/frame_00001.jpg and so on.

    Returns: their paths in the folder.
    Raises: DataError where the video, or what reads videos, is missing, or it has no frame.
    """
    count, frames = open_video(video)
    folder.mkdir(parents=True)
    names = []
    for index, frame in enumerate(sharpest(track(frames, "Reading the video", total=count), count, target)):
        names.append(Path(f"frame_{index + 1:05d}.jpg"))
        save(Image.fromarray(frame[..., :3]), folder / names[-1])
    if not names:
        raise DataError(f"--data {video} has no frame that can be decoded")
    return names


def open_video(path: Path) -> tuple[int, Iterator[np.ndarray]]:
    """About how many frames a video has, and the frames (H, W, 3) uint8, turned as they are to be seen.

    Raises: DataError where it is missing, what reads it is not installed, or it is no video.
    """
    if not path.is_file():
        raise DataError(f"--data {path}: there is no such file")
    if (advice := missing("video")) is not None:
        raise DataError(f"reading a video needs ffmpeg: {advice}")
    import imageio.v3 as iio

    try:
        about: dict[str, Any] = iio.immeta(path, plugin="FFMPEG")
        count = round(float(about["fps"]) * float(about["duration"]))
    except Exception as error:  # whatever ffmpeg and its wrapper raise
        first = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise DataError(f"--data {path} is not a readable video: {first}") from error
    return max(count, 1), _frames(path)


def sharpest(frames: Iterable[np.ndarray], count: int, target: int) -> Iterator[np.ndarray]:
    """The sharpest frame of each interval, in their order; one frame is held at a time.

    Args:
        frames: (H, W, 3) uint8.
        count: how many there are, or about so: more are taken as further intervals of the same length.
        target: number of intervals; every frame where there are not more.
    """
    length = max(count / target, 1.0)
    best: np.ndarray | None = None
    best_sharpness, interval = -1.0, 0
    for index, frame in enumerate(frames):
        now = int((index + 1e-9) / length)
        if now != interval and best is not None:
            yield best
            best, best_sharpness = None, -1.0
        interval = now
        measured = sharpness(frame)
        if measured > best_sharpness:
            best, best_sharpness = frame, measured
    if best is not None:
        yield best


def sharpness(frame: np.ndarray) -> float:
    """Variance of the Laplacian of the green channel, of a frame (H, W, 3) reduced to at most 1000 pixels a side.

    Pech-Pacheco et al. 2000, "Diatom autofocusing in brightfield microscopy".
    """
    factor = max(1, -(-max(frame.shape[:2]) // 1000))
    height, width = (side // factor for side in frame.shape[:2])
    if min(height, width) < 3:
        return 0.0
    green = frame[: height * factor, : width * factor, 1].astype(np.float32)
    green = green.reshape(height, factor, width, factor).mean((1, 3))
    inner = green[1:-1, 1:-1]
    laplacian = green[:-2, 1:-1] + green[2:, 1:-1] + green[1:-1, :-2] + green[1:-1, 2:] - 4 * inner
    return float(laplacian.var())


def _frames(path: Path) -> Iterator[np.ndarray]:
    import imageio.v3 as iio

    try:
        yield from iio.imiter(path, plugin="FFMPEG")
    except Exception as error:  # a file that was cut short; what came before is used
        first = (str(error).strip().splitlines() or [type(error).__name__])[0]
        say(f"{path} cannot be decoded to its end; what came before is used: {first}")
