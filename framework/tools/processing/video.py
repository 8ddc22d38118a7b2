"""Extraction of images from a video: the sharpest frame of each of many equal intervals."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from framework.base.console import say, track
from framework.base.errors import DataError
from framework.base.extras import install_command
from framework.tools.processing.images import save


def write_frames(video: Path, folder: Path, target: int) -> list[Path]:
    """Write about `target` frames of a video as folder/frame_00001.jpg and so on.

    Args:
        video: the video file.
        folder: folder to create.
        target: number of frames to write.

    Returns:
        The paths of the frames in the folder.

    Raises:
        DataError: if the video or ffmpeg is missing, or the video has no readable frame.
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
    """Return the approximate number of frames of a video, and its frames (H, W, 3) uint8, upright.

    Args:
        path: the video file.

    Raises:
        DataError: if the file or ffmpeg is missing, or the file is not a readable video.
    """
    if not path.is_file():
        raise DataError(f"--data {path}: there is no such file")
    if (advice := install_command("video")) is not None:
        raise DataError(f"reading a video needs ffmpeg: {advice}")
    import imageio.v3 as iio

    try:
        metadata: dict[str, Any] = iio.immeta(path, plugin="FFMPEG")
        count = round(float(metadata["fps"]) * float(metadata["duration"]))
    except Exception as error:  # any type, from ffmpeg or its wrapper
        first = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise DataError(f"--data {path} is not a readable video: {first}") from error
    return max(count, 1), _frames(path)


def sharpest(frames: Iterable[np.ndarray], count: int, target: int) -> Iterator[np.ndarray]:
    """Yield the sharpest frame of each interval in order, holding one frame at a time.

    Args:
        frames: (H, W, 3) uint8.
        count: approximate number of frames; further frames form further intervals of the same length.
        target: number of intervals; if there are fewer frames, all are yielded.
    """
    length = max(count / target, 1.0)
    best: np.ndarray | None = None
    best_sharpness, interval = -1.0, 0
    for index, frame in enumerate(frames):
        current = int((index + 1e-9) / length)
        if current != interval and best is not None:
            yield best
            best, best_sharpness = None, -1.0
        interval = current
        measured = sharpness(frame)
        if measured > best_sharpness:
            best, best_sharpness = frame, measured
    if best is not None:
        yield best


def sharpness(frame: np.ndarray) -> float:
    """Return the variance of the Laplacian of a frame's green channel, after reduction to at most 1000 pixels a side.

    Pech-Pacheco et al. 2000, "Diatom autofocusing in brightfield microscopy".

    Args:
        frame: (H, W, 3) uint8.
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
    except Exception as error:  # a truncated file; the frames before are used
        first = (str(error).strip().splitlines() or [type(error).__name__])[0]
        say(f"{path} cannot be decoded to its end; the frames before are used: {first}")
