"""Videos and folders of images: an independent reader reads back the written files."""

import errno
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
from PIL import Image

from nerfloom.base import extras
from nerfloom.base.errors import ConfigError
from nerfloom.evaluation import videos
from nerfloom.evaluation.video_suffixes import check_suffix
from nerfloom.evaluation.videos import (
    write_distances,
    write_images,
    write_strip,
    write_video,
)


def greys(*levels: int, size: tuple[int, int] = (8, 8)) -> list[np.ndarray]:
    return [np.full((*size, 3), level, np.uint8) for level in levels]


@pytest.mark.parametrize("ending", [".gif", ".webp", ".png"])
def test_an_animation_has_all_its_frames_and_their_duration(tmp_path: Path, ending: str) -> None:
    path = tmp_path / "new" / f"a{ending}"
    write_video(path, iter(greys(0, 64, 128, 255)), fps=10)
    with Image.open(path) as read:
        assert getattr(read, "n_frames", 1) == 4
        levels = []
        for index in range(4):
            read.seek(index)
            levels.append(read.convert("RGB").getpixel((4, 4))[0])
            assert read.info["duration"] == 100
        assert read.info["loop"] == 0
    assert levels == pytest.approx([0, 64, 128, 255], abs=3)
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_a_colon_in_a_name_is_no_protocol(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("imageio_ffmpeg")
    monkeypatch.chdir(tmp_path)
    write_video(Path("12:30.mp4"), iter(greys(50, 200)), fps=10)
    pictures = iio.imread(tmp_path / "12:30.mp4", plugin="FFMPEG")
    assert [round(float(picture.mean())) for picture in pictures] == pytest.approx([50, 200], abs=6)


@pytest.mark.parametrize("fps", [24, 30, 48])
@pytest.mark.parametrize(("ending", "unit"), [(".gif", 10), (".webp", 1), (".png", 1)])
def test_an_animation_is_as_long_as_its_frames(tmp_path: Path, ending: str, unit: int, fps: int) -> None:
    """Durations in a file are whole numbers of a unit, milliseconds; twelve frames take a whole number of units."""
    write_video(tmp_path / f"a{ending}", iter(greys(*range(0, 240, 20))), fps=fps)
    durations = []
    with Image.open(tmp_path / f"a{ending}") as read:
        for index in range(12):
            read.seek(index)
            read.load()
            durations.append(float(read.info["duration"]))
    assert sum(durations) == pytest.approx(12 * 1000 / fps)
    assert all(abs(duration - 1000 / fps) < unit for duration in durations)


def test_a_video_of_an_odd_size_shows_what_was_given(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg")
    rows, columns = np.mgrid[:45, :63]
    phases = [np.stack([columns / 20 + index / 4, rows / 15, 0 * rows], axis=-1) for index in range(12)]
    given = [(128 + 100 * np.sin(phase)).astype(np.uint8) for phase in phases]
    write_video(tmp_path / "a.mp4", given, fps=12.5)
    found = iio.imread(tmp_path / "a.mp4", plugin="FFMPEG")
    facts = iio.immeta(tmp_path / "a.mp4", plugin="FFMPEG")
    assert found.shape == (12, 46, 64, 3)  # H.264 has no odd sizes: the last row and column stand twice
    assert (facts["fps"], facts["codec"]) == (12.5, "h264")
    for one, other in zip(given, found, strict=True):
        error = np.abs(one.astype(float) - other[:45, :63])
        assert error.mean() < 2.5
        assert error.max() < 12
    first = (tmp_path / "a.mp4").read_bytes()
    write_video(tmp_path / "a.mp4", given, fps=12.5)
    assert (tmp_path / "a.mp4").read_bytes() == first


def test_images_and_a_strip(tmp_path: Path) -> None:
    paths = [tmp_path / "png" / "0.png", tmp_path / "jpg" / "1.jpg"]
    write_images(paths, greys(10, 200))
    assert [iio.imread(path)[3, 3].tolist() for path in paths] == [[10] * 3, [200] * 3]
    assert [Image.open(path).format for path in paths] == ["PNG", "JPEG"]
    write_strip(tmp_path / "strip.png", greys(1, 2, 3))
    assert iio.imread(tmp_path / "strip.png")[0, ::8, 0].tolist() == [1, 2, 3]


def test_distances_are_numbers(tmp_path: Path) -> None:
    distances = np.array([[0.0, 0.4], [2.0, 1e-9]], np.float32)
    write_distances([tmp_path / "a.npy"], [distances], 1.0)
    assert np.array_equal(np.load(tmp_path / "a.npy"), distances)
    write_distances([tmp_path / "a.png"], [np.append(distances, [[3.0, 9.0]], axis=0)], 3 / 65535)
    read = iio.imread(tmp_path / "a.png")
    assert read.dtype == np.uint16
    # 0 is unknown, so the smallest distance is 1, and larger ones become the largest value.
    assert read.tolist() == [[0, 8738], [43690, 1], [65535, 65535]]


def test_what_cannot_be_written_is_told_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a.gif", "a.WEBP", "folder"):
        check_suffix(tmp_path / name)
    with pytest.raises(ConfigError, match=r".mp4, .gif, .webp, .png"):
        check_suffix(tmp_path / "a.avi")
    monkeypatch.setattr(extras, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"the extra \[video\]: pip install 'imageio\[ffmpeg\]'; or name a .gif"):
        check_suffix(tmp_path / "a.mp4")


@pytest.mark.parametrize("ending", [".gif", ".mp4"])
def test_a_full_disk_leaves_what_was_there(tmp_path: Path, ending: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if ending == ".mp4":
        pytest.importorskip("imageio_ffmpeg")
    path = tmp_path / f"a{ending}"
    path.write_bytes(b"before")

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(videos.os, "replace", full)
    with pytest.raises(ConfigError, match=r"cannot write .*: No space left on device; the frames are kept"):
        write_video(path, greys(1, 2, size=(32, 32)), fps=4)
    assert path.read_bytes() == b"before"
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_a_stop_while_writing_leaves_nothing(tmp_path: Path) -> None:
    def stopped() -> Iterator[np.ndarray]:
        yield from greys(1, 2)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "a.gif", stopped(), fps=4)
    assert list(tmp_path.iterdir()) == []
