"""Videos, animations and folders of images, written from pictures one after another."""

from __future__ import annotations

import io
import os
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image

from nerfloom.base.errors import ConfigError
from nerfloom.evaluation.frames import write_file
from nerfloom.evaluation.video_suffixes import VIDEO

PRESET, QUALITY = "superfast", 19
"""Preset and constant rate factor of H.264. For 45 frames of a cup, 1920 x 1080, the error is 0.3 dB below that of the
default preset with 18, which is considered visually lossless. Files are 40 % larger; encoding takes a quarter of the
time."""
JPEG_QUALITY = 95
"""Quality of JPEG images, 1 to 95."""
GIF_UNIT = 10
"""Unit of the durations in a GIF, milliseconds."""
MAX_UINT16 = 65_535
"""Largest value of a 16-bit PNG."""


def write_video(path: Path, pictures: Iterable[np.ndarray], fps: float) -> None:
    """Write a video or an endless animation; an earlier file stays until the new one is complete and on the disk.

    Args:
        path: file to write; its suffix is the format: .mp4 (H.264), .gif, .webp or .png.
        pictures: (H, W, 3) uint8 pictures of one size, at least one.
        fps: frames per second.

    Raises:
        ConfigError: if the file cannot be written.
    """
    with _whole(path) as temporary:
        if path.suffix.lower() == VIDEO:
            _write_mp4(temporary, pictures, fps)
        else:
            _write_animation(temporary, pictures, fps)


def join_videos(path: Path, parts: Sequence[Path], seconds: Sequence[float]) -> None:
    """Write the pictures of several videos one after another, as they are encoded, to one video.

    Args:
        path: .mp4 file to write.
        parts: .mp4 files of `write_video`, of one size and speed, in one folder. Their list is written there too. They
            have at least five pictures each, or the encoder does not delay all of them by the same number of pictures.
        seconds: their exact durations; the files round them to milliseconds.

    Raises:
        ConfigError: if the file cannot be written.
    """
    import imageio_ffmpeg  # type: ignore[import-untyped]

    listed = parts[0].absolute().with_name("parts.txt")
    with _whole(path) as temporary:
        lines = [f"file '{part.name}'\nduration {length:.6f}\n" for part, length in zip(parts, seconds, strict=True)]
        listed.write_text("".join(lines), encoding="utf-8")
        words = ["-v", "error", "-f", "concat", "-i", listed, "-c", "copy", "-movflags", "+faststart", "-y", temporary]
        command = [imageio_ffmpeg.get_ffmpeg_exe(), *map(str, words)]
        done = subprocess.run(command, stdin=subprocess.DEVNULL, stderr=subprocess.PIPE)
        if done.returncode:
            raise RuntimeError(done.stderr.decode(errors="replace"))


@contextmanager
def _whole(path: Path) -> Iterator[Path]:
    """Yield a temporary file that takes the place of `path`, when the block has written it and it is on the disk."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # ffmpeg takes what stands before a colon in a relative path for a protocol.
    temporary = path.absolute().with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        with _written(path):
            yield temporary
            with temporary.open("rb+") as file:
                os.fsync(file.fileno())
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def _written(path: Path) -> Iterator[None]:
    """Convert errors of the system or an encoder to one-line errors."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or "the encoder failed"
        if isinstance(error, BrokenPipeError):
            reason = "ffmpeg ended early; is the disk full?"
        raise ConfigError(f"cannot write {path}: {reason}; the frames are kept; repeat the command") from error


def _write_mp4(path: Path, pictures: Iterable[np.ndarray], fps: float) -> None:
    import imageio.v2 as imageio

    writer = imageio.get_writer(
        path,
        format="FFMPEG",
        mode="I",
        fps=fps,
        codec="libx264",
        quality=None,
        macro_block_size=1,
        pixelformat="yuv420p",
        ffmpeg_log_level="error",
        output_params=["-crf", str(QUALITY), "-preset", PRESET, "-movflags", "+faststart"],
    )
    with writer:
        for picture in pictures:
            writer.append_data(_even(picture))


def _even(picture: np.ndarray) -> np.ndarray:
    """Repeat a picture's last row or column where its size is odd; H.264 needs even sizes."""
    height, width = picture.shape[:2]
    if height % 2 == width % 2 == 0:
        return picture  # numpy's pad copies also where it adds nothing
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def _write_animation(path: Path, pictures: Iterable[np.ndarray], fps: float) -> None:
    unit = GIF_UNIT if path.suffix.lower() == ".gif" else 1
    durations: list[int] = []

    def images() -> Iterator[Image.Image]:
        for number, picture in enumerate(pictures):
            # A frame ends at the whole unit nearest to its end, so that the animation has its length.
            durations.append(unit * (_units(number + 1, fps, unit) - _units(number, fps, unit)))
            yield Image.fromarray(picture)

    given = images()
    first = next(given)
    # Pillow iterates over the images of a PNG twice, so they must be in memory. It reads a duration after its image.
    others = list(given) if path.suffix.lower() == ".png" else given
    first.save(path, save_all=True, append_images=others, duration=durations, loop=0)


def _units(frames: int, fps: float, unit: int) -> int:
    """Return the duration of a number of frames in whole units of `unit` milliseconds."""
    return round(1000 * frames / fps / unit)


def write_strip(path: Path, pictures: Iterable[np.ndarray]) -> None:
    """Write `pictures`, (H, W, 3) uint8 of one height, side by side to a PNG file `path`.

    Raises:
        ConfigError: if the file cannot be written.
    """
    write_file(path, _encoded(np.concatenate(list(pictures), axis=1), ".png"))


def write_images(paths: Iterable[Path], pictures: Iterable[np.ndarray]) -> None:
    """Write each of `pictures`, (H, W, 3) uint8, to its own .png or .jpg of `paths`; folders are created.

    Raises:
        ConfigError: if a file cannot be written.
    """
    for path, picture in zip(paths, pictures, strict=True):
        write_file(path, _encoded(picture, path.suffix))


def write_distances(paths: Iterable[Path], distances: Iterable[np.ndarray], unit: float) -> None:
    """Write each distance map to its own file; missing folders are created.

    Args:
        paths: files to write: .npy (float32), or .png (16 bits, distances in `unit`, clipped at the largest value).
        distances: (H, W) float32 distances, 0 where unknown.
        unit: distance for the value 1 of a PNG.

    Raises:
        ConfigError: if a file cannot be written.
    """
    for path, values in zip(paths, distances, strict=True):
        if path.suffix == ".npy":
            content = io.BytesIO()
            np.save(content, values, allow_pickle=False)
            write_file(path, content.getvalue())
        else:
            steps = np.clip(np.round(values.astype(np.float64) / unit), 0, MAX_UINT16).astype(np.uint16)
            write_file(path, _encoded(np.where(values > 0, np.maximum(steps, 1), 0).astype(np.uint16), ".png"))


def _encoded(pixels: np.ndarray, suffix: str) -> bytes:
    content = io.BytesIO()
    if suffix == ".png":
        Image.fromarray(pixels).save(content, "PNG", compress_level=3)
    else:
        Image.fromarray(pixels).save(content, "JPEG", quality=JPEG_QUALITY, subsampling=0)
    return content.getvalue()
