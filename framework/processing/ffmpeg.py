"""Frames of a video as stored, with their times, by ffmpeg: none is added, left out or moved in time."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from pathlib import Path
from typing import IO, TypeVar

import numpy as np

from nerfloom.base.console import say, track
from nerfloom.base.errors import DataError
from nerfloom.base.extras import install_command
from nerfloom.base.lfs import ADVICE, is_pointer

MAX_SIDE = 1000
"""Maximum side of the grey pictures used to judge frames, pixels."""
_GREY = f"scale=min({MAX_SIDE}\\,iw):min({MAX_SIDE}\\,ih):force_original_aspect_ratio=decrease:flags=area,format=gray"

HDR = {"arib-std-b67": "HLG", "smpte2084": "PQ"}
"""ffmpeg's name of a video's transfer function with a high dynamic range -> the usual name."""
_TO_STANDARD_RANGE = (
    "zscale=t=linear:npl=203,format=gbrpf32le,zscale=p=bt709,tonemap=mobius:desat=0:peak=5,zscale=t=bt709,format=rgb24"
)
"""Filters for such a video. White is at 203 cd/m2 (ITU-R BT.2408), and the light up to five times as bright is
compressed. The peak is fixed, so that all frames are mapped alike."""

R = TypeVar("R")


def frame_count(path: Path) -> int:
    """Return the number of frames that the container of the video `path` lists.

    Raises:
        DataError: if the file or ffmpeg is missing, or the file is not a readable video.
    """
    if path.is_dir():
        raise DataError(f"--data {path} is a folder without a video; name a video, or a folder with one")
    if not path.is_file():
        raise DataError(f"--data {path}: there is no such file")
    if (advice := install_command("video")) is not None:
        raise DataError(f"reading a video needs ffmpeg: {advice}")
    import imageio_ffmpeg  # type: ignore[import-untyped]

    try:
        count, _ = imageio_ffmpeg.count_frames_and_secs(_named(path))
    except Exception as error:  # any type, from ffmpeg or its wrapper
        advice = ADVICE if is_pointer(path) else "play it to check that it is complete"
        raise DataError(f"--data {path} is not a readable video; {advice}") from error
    return max(int(count), 1)


def survey(path: Path, look: Callable[[np.ndarray], R]) -> tuple[np.ndarray, list[R]]:
    """Apply a function to a small grey picture of each frame.

    A video that cannot be decoded to its end is used up to there, with a warning.

    Args:
        path: the video file.
        look: function of an upright picture (H, W) uint8 with at most `MAX_SIDE` pixels a side.

    Returns:
        The times of the frames, seconds, in order, and the results.

    Raises:
        DataError: if no frame can be decoded.
    """
    with tempfile.TemporaryDirectory() as folder:
        listed = Path(folder) / "times"
        graph = f"[0:v:0]{_GREY},split[seen][timed]"
        kept = [*_passthrough(), "-map", "[seen]", "-c:v", "pgm", "-f", "image2pipe", "pipe:1"]
        timed = [*_passthrough(), "-map", "[timed]", "-f", "framecrc", str(listed)]
        arguments = ["-i", _named(path), "-filter_complex", graph, *kept, *timed]
        frames = track(_pictures(path, arguments), "Looking at the video", total=frame_count(path))
        results = [look(frame[..., 0]) for frame in frames]
        times = _times(listed)[: len(results)] if results else np.zeros(0)
    if len(times) == 0:
        raise DataError(f"--data {path} has no readable frame")
    return np.maximum.accumulate(times), results[: len(times)]


def chosen_frames(path: Path, numbers: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the frames `numbers` (K,), ascending from 0, of the video `path` as (H, W, 3) uint8, upright."""
    filters = _to_standard_range(path)
    arguments = ["-i", _named(path), "-map", "0:v:0", *filters, *_passthrough(), "-c:v", "ppm", "-pix_fmt", "rgb24"]
    wanted = iter(track(numbers.tolist(), "Reading the frames", total=len(numbers)))
    number = next(wanted, None)
    with closing(_pictures(path, [*arguments, "-f", "image2pipe", "pipe:1"])) as frames:
        for index, frame in enumerate(frames):
            if index == number:
                yield frame
                number = next(wanted, None)
            if number is None:
                return


def _named(path: Path) -> str:
    """Return the name of a file for ffmpeg, which takes what stands before a colon for a protocol."""
    return str(path.absolute())


def _pictures(path: Path, arguments: list[str]) -> Generator[np.ndarray, None, None]:
    """Yield pictures (H, W, C) uint8 from ffmpeg's stream of PGM or PPM files."""
    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-nostdin", "-loglevel", "error", *arguments]
    with tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, stdin=subprocess.DEVNULL)
        assert process.stdout is not None
        try:
            while (picture := _next_picture(process.stdout)) is not None:
                yield picture
            if process.wait() != 0:
                errors.seek(0)
                last = errors.read().decode(errors="replace").strip().splitlines()[-1:] or ["ffmpeg failed"]
                say(f"{path} cannot be decoded to its end; using the frames before: {last[0].strip()}")
        finally:
            process.kill()
            process.wait()
            process.stdout.close()


def _next_picture(stream: IO[bytes]) -> np.ndarray | None:
    """Read a PGM or PPM file written by ffmpeg, with three lines of text before its pixels; None at the end."""
    kind, size, _ = (stream.readline() for _ in range(3))
    if len(size.split()) != 2:
        return None
    width, height = map(int, size.split())
    shape = (height, width, 3 if kind.strip() == b"P6" else 1)
    content = stream.read(int(np.prod(shape)))
    return np.frombuffer(content, np.uint8).reshape(shape) if len(content) == np.prod(shape) else None


def _times(listed: Path) -> np.ndarray:
    """Read the times (N,) of frames, seconds, from a file in ffmpeg's framecrc format."""
    second, times = 1.0, []
    for line in listed.read_text(errors="replace").splitlines():
        if line.startswith("#tb 0:"):
            numerator, denominator = line.partition(":")[2].split("/")
            second = int(numerator) / int(denominator)
        elif line and not line.startswith("#"):
            times.append(int(line.split(",")[2]) * second)
    return np.array(times)


def _to_standard_range(path: Path) -> list[str]:
    """Return ffmpeg's options that tone-map a video with a high dynamic range; none for others. This is reported.

    Phones record such videos by default. Without tone-mapping their frames are grey.
    """
    shown = next((line for line in _said("-i", _named(path)).splitlines() if "Video:" in line), "")
    kind = next((kind for name, kind in HDR.items() if name in shown), None)
    if kind is None:
        return []
    filters = _said("-filters")
    if " zscale " not in filters or " tonemap " not in filters:
        say(
            f"{path} is HDR video ({kind}), and this ffmpeg cannot tone-map it, so its frames are grey: convert it "
            "first, or set IMAGEIO_FFMPEG_EXE to an ffmpeg with the filter zscale"
        )
        return []
    say(f"{path} is HDR video ({kind}): its frames are tone-mapped to the standard range")
    return ["-vf", _TO_STANDARD_RANGE]


def _passthrough() -> list[str]:
    """Return ffmpeg's option to keep each frame once, at its time; before version 5.1 it is -vsync."""
    return ["-fps_mode" if "fps_mode" in _said("-h", "long") else "-vsync", "passthrough"]


def _said(*arguments: str) -> str:
    """Return what ffmpeg prints."""
    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", *arguments]
    done = subprocess.run(command, capture_output=True, stdin=subprocess.DEVNULL, check=False)
    return (done.stdout + done.stderr).decode(errors="replace")
