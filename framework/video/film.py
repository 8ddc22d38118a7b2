"""A video that is encoded while its frames are rendered, part by part, so that few frames are on the disk."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from itertools import islice
from pathlib import Path

import numpy as np

from nerfloom.base.console import track
from nerfloom.evaluation.frames import Frames
from nerfloom.evaluation.outputs import Arrays
from nerfloom.evaluation.videos import join_videos, write_video

PART_BYTES, MIN_PART = 2**28, 30
"""Number of bytes of the frames of a part, and the minimum number of its frames. A part begins with a picture that
refers to no other, so short parts make a large file."""


def part_length(frame_bytes: int) -> int:
    """Return the minimum number of frames of a part from `frame_bytes`, the number of bytes of a frame."""
    return max(PART_BYTES // frame_bytes, MIN_PART)


def render_film(
    frames: Frames,
    render: Callable[[int], Arrays],
    picture: Callable[[Arrays], np.ndarray],
    path: Path,
    fps: float,
) -> None:
    """Render frames, and write them to a video. While the frames of a part are rendered, those before it are encoded.

    A stopped film continues with its parts and the frames after them, and the file has the same bytes.

    Args:
        frames: the frames; some may be there already.
        render: function that returns the arrays of a frame from its index.
        picture: function that returns the picture (H, W, 3) uint8 of a frame from its arrays.
        path: .mp4 file to write.
        fps: frames per second.

    Raises:
        ConfigError: if a file cannot be written.
    """

    def encode(part: range, pictures: Iterator[np.ndarray]) -> None:
        write_video(frames.part_path(part), pictures, fps)
        for index in part:
            frames.path(index).unlink(missing_ok=True)

    with frames.resumable():
        missing = frames.missing()
        left = [part for part in frames.parts if not frames.part_path(part).exists()]
        encoding: Future[None] | None = None
        with ThreadPoolExecutor(1) as encoder, closing(frames.rendered(missing, render)) as rendered:
            for part in left:
                for _ in islice(rendered, sum(index in part for index in missing)):
                    pass
                if encoding is not None:
                    encoding.result()  # so that the frames of two parts are on the disk at most
                if part is not left[-1]:
                    encoding = encoder.submit(encode, part, map(picture, frames.read_all(part)))
            next(rendered, None)  # which ends the progress of rendering
            if left:
                pictures = map(picture, frames.read_all(left[-1]))
                encode(left[-1], track(pictures, "Writing", total=len(left[-1])))
        parts = frames.parts
        join_videos(path, [frames.part_path(part) for part in parts], [len(part) / fps for part in parts])
