"""Choice of a video's frames: distinct frames, spread evenly over time, the sharpest in each interval."""

from __future__ import annotations

import numpy as np

BLOCK = 16
"""Side of the squares for comparing mean brightness between frames, pixels."""
MAX_REPEAT_DIFFERENCE = 0.003
"""Maximum difference between repeated frames, as a fraction of their contrast. In videos encoded by x264 and MPEG-4,
repeated frames differed by up to 0.0025, and frames moved by half a pixel by 0.004 or more."""


def sharpness(picture: np.ndarray) -> float:
    """Return the variance of the Laplacian of a picture.

    Pech-Pacheco et al. 2000, "Diatom autofocusing in brightfield microscopy".

    Args:
        picture: (H, W) uint8.
    """
    if min(picture.shape) < 3:
        return 0.0
    grey = picture.astype(np.float32)
    inner = grey[1:-1, 1:-1]
    laplacian = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:] - 4 * inner
    return float(laplacian.var())


def blocks(picture: np.ndarray) -> np.ndarray:
    """Return the mean of each square of `BLOCK` pixels a side, (h, w) float32, of a `picture` (H, W) uint8."""
    height, width = (max(side // BLOCK, 1) for side in picture.shape)
    rows, columns = (min(side, BLOCK) for side in picture.shape)
    squares = picture[: height * rows, : width * columns].reshape(height, rows, width, columns)
    return squares.mean((1, 3), dtype=np.float32)


def different(frames: list[np.ndarray]) -> np.ndarray:
    """Return the indices of frames that differ from the last distinct frame, in ascending order.

    A frame is a repeat if its blocks differ on average by at most `MAX_REPEAT_DIFFERENCE` of the contrast.
    Encoders and players repeat frames to keep a rate, and a camera that stands still repeats its view.

    Args:
        frames: `blocks` of each frame.
    """
    kept: list[int] = []
    for number, frame in enumerate(frames):
        last = frames[kept[-1]] if kept else None
        if last is None or np.abs(frame - last).mean() > MAX_REPEAT_DIFFERENCE * last.std():
            kept.append(number)
    return np.array(kept, np.int64)


def intervals(times: np.ndarray, count: int) -> np.ndarray:
    """Divide frames into non-empty intervals of equal duration.

    A pause without frames that is longer than an interval counts as one interval, so that the number of intervals is as
    requested. The interval's length L solves sum(min(d, L)) = count L, with the durations d of frames.

    Args:
        times: (N,) seconds, ascending.
        count: number of intervals.

    Returns:
        (N,) interval of each frame, counted from 0; if there are no more than `count` frames, each has its own.
    """
    if len(times) <= count:
        return np.arange(len(times))
    gaps = np.diff(times)
    durations = np.append(gaps, gaps[-1])
    durations = np.maximum(durations, 1e-3 * durations.mean()) if durations.any() else np.ones(len(times))
    low, high = 0.0, float(durations.sum()) / count
    for _ in range(100):
        middle = (low + high) / 2
        low, high = (middle, high) if np.minimum(durations, middle).sum() > count * middle else (low, middle)
    starts = np.concatenate([[0.0], np.cumsum(np.minimum(durations, high))[:-1]])
    return np.minimum(np.floor(starts / high + 1e-9).astype(np.int64), count - 1)


def sharpest(sharpnesses: np.ndarray, groups: np.ndarray) -> np.ndarray:
    """Return the index of the sharpest frame of each group; of equally sharp frames, the first.

    Args:
        sharpnesses: (N,) sharpness of each frame.
        groups: (N,) group of each frame.

    Returns:
        (G,) indices, in the order of groups.
    """
    order = np.lexsort((np.arange(len(groups)), -sharpnesses, groups))
    first = np.append(True, np.diff(groups[order]) > 0)[: len(order)]
    return order[first]
