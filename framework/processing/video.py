"""Extraction of images from a video: distinct frames as stored, the sharpest of each of equal intervals."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from nerfloom.base.console import say
from nerfloom.base.counts import counted
from nerfloom.processing import frame_choice
from nerfloom.processing.ffmpeg import chosen_frames, survey
from nerfloom.processing.images import save


def write_frames(video: Path, folder: Path, target: int) -> list[Path]:
    """Write `target` distinct frames of a video, or all if it has fewer, as folder/frame_00001.jpg and so on.

    Args:
        video: the video file.
        folder: folder to create.
        target: number of frames to write.

    Returns:
        The paths of the frames in the folder.

    Raises:
        DataError: if the video or ffmpeg is missing, or the video has no readable frame.
    """
    times, seen = survey(video, lambda picture: (frame_choice.sharpness(picture), frame_choice.blocks(picture)))
    fresh = frame_choice.different([squares for _, squares in seen])
    sharpnesses = np.array([seen[number][0] for number in fresh])
    numbers = fresh[frame_choice.sharpest(sharpnesses, frame_choice.intervals(times[fresh], target))]
    folder.mkdir(parents=True)
    names = []
    for index, frame in enumerate(chosen_frames(video, numbers)):
        names.append(Path(f"frame_{index + 1:05d}.jpg"))
        save(Image.fromarray(frame), folder / names[-1])
    say(line(times, len(fresh), target, len(names)))
    return names


def line(times: np.ndarray, fresh: int, target: int, written: int) -> str:
    """Return a line on frames at `times` (N,), seconds: `fresh` ones differ, and `written` of `target` were taken."""
    count, gaps = len(times), np.diff(times)
    uneven = " at uneven times" if count > 2 and gaps.max() > 1.5 * max(np.median(gaps), 1e-9) else ""
    text = f"video: {counted(count, 'frames')} in {times[-1] - times[0]:.1f} s{uneven}"
    if fresh < count:
        text += f", {count - fresh} of them repeat the one before and are dropped"
    if written < target:
        taken = "the only one" if written == 1 else f"all {written}"
        return f"{text}; using {taken}, fewer than --num-frames-target {target}"
    return f"{text}; using {written}, the sharpest of each of {target} intervals"
