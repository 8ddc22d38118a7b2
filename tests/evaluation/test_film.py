"""A video that is encoded while its frames are rendered: whole, even, and the same after a stop."""

import subprocess
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from nerfloom.evaluation.frames import Frames, open_frames
from nerfloom.evaluation.outputs import Arrays
from nerfloom.video.film import part_length, render_film

ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="the extra [video] is not installed")
COUNT, PART = 17, 5


class Waves:
    """Frames of a pattern that moves; stops at a frame. Counts the frames that are on the disk meanwhile."""

    def __init__(self, folder: Path, stop: int | None = None) -> None:
        self.folder, self.stop = folder, stop
        self.rendered, self.kept = list[int](), 0

    def __call__(self, index: int) -> Arrays:
        if index == self.stop:
            raise KeyboardInterrupt
        self.rendered.append(index)
        self.kept = max(self.kept, len(list(self.folder.glob("*.frames/*/*.npz"))))
        rows, columns = np.mgrid[:46, :64]
        phase = np.stack([columns / 20 + index / 4, rows / 15, 0 * rows], axis=-1)
        return {"rgb": (128 + 100 * np.sin(phase)).astype(np.uint8)}


def film(path: Path, render: Waves, fps: float) -> Frames:
    """Render the film, or a part of it."""
    frames = open_frames(path, COUNT, {}, PART)
    render_film(frames, render, lambda kept: kept["rgb"], path, fps)
    return frames


@pytest.mark.medium
@pytest.mark.parametrize("fps", [24.0, 29.97, 30.0])
def test_a_film_is_whole_and_even_and_the_same_after_a_stop(fps: float, tmp_path: Path) -> None:
    whole, parts = tmp_path / "whole.mp4", tmp_path / "parts.mp4"
    render = Waves(tmp_path)
    film(whole, render, fps).remove()
    assert render.rendered == list(range(COUNT))
    assert render.kept < 3 * PART  # of two parts; the last one is longer
    first, second = Waves(tmp_path, stop=13), Waves(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        film(parts, first, fps)
    assert not parts.exists()
    assert len(list(tmp_path.glob("parts.mp4.frames/*/*.mp4"))) == 2
    film(parts, second, fps).remove()
    assert first.rendered + second.rendered == list(range(COUNT))
    assert parts.read_bytes() == whole.read_bytes()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["parts.mp4", "whole.mp4"]

    found = iio.imread(whole, plugin="FFMPEG")
    assert found.shape == (COUNT, 46, 64, 3)
    for index, picture in enumerate(found):
        assert np.abs(picture.astype(float) - render(index)["rgb"]).mean() < 2.5
    words = ("-v", "error", "-i", str(whole), "-c", "copy", "-f", "framecrc", "-")
    command = [ffmpeg.get_ffmpeg_exe(), *words]
    listed = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    (base,) = [line.split()[-1].split("/") for line in listed if line.startswith("#tb 0")]
    ticks = [[int(word) for word in line.split(",")[1:3]] for line in listed if not line.startswith("#")]
    decoded, presented = (np.array(ticks) * int(base[0]) / int(base[1]) * fps).T
    np.testing.assert_allclose(decoded - decoded[0], np.arange(COUNT), atol=1e-6)
    np.testing.assert_allclose(sorted(presented), np.arange(COUNT), atol=1e-6)


def test_parts_are_of_few_bytes_or_of_thirty_frames() -> None:
    assert part_length(3 * 1920 * 1080) == 43
    assert part_length(3 * 7680 * 4320) == 30
