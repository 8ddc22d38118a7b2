"""Frames of a video: as they are stored, each once, evenly over time, and the sharpest nearby."""

import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nerfloom.base.errors import DataError
from nerfloom.processing.ffmpeg import chosen_frames, frame_count, survey
from nerfloom.processing.frame_choice import blocks, different, intervals, sharpest, sharpness
from nerfloom.processing.video import line, write_frames

BITS = 6
"""Squares of a frame; their brightness is its number in binary."""


def frame(blur: int, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 255, (40, 60)).astype(np.float64)
    for _ in range(blur):
        noise = (noise + np.roll(noise, 1, 0) + np.roll(noise, 1, 1)) / 3
    return noise.astype(np.uint8)


def test_blur_lowers_sharpness() -> None:
    found = [sharpness(frame(blur)) for blur in range(4)]
    assert found == sorted(found, reverse=True)
    assert sharpness(np.zeros((2, 2), np.uint8)) == 0


def test_the_sharpest_of_each_interval_is_taken() -> None:
    values = np.array([sharpness(frame(blur, index)) for index, blur in enumerate([2, 0, 3, 1, 3, 2])])
    assert sharpest(values, intervals(np.arange(6.0), 2)).tolist() == [1, 3]
    assert sharpest(np.ones(4), np.array([0, 0, 1, 1])).tolist() == [0, 2]


@pytest.mark.parametrize("seed", range(5))
def test_there_are_as_many_intervals_as_asked_for_whatever_the_times(seed: int) -> None:
    random = np.random.default_rng(seed)
    times = np.cumsum(random.choice([0.0, 0.01, 0.02, 0.5, 20.0], 200))
    for count in (1, 3, 50, 199, 200, 300):
        found = intervals(times, count)
        assert np.array_equal(np.unique(found), np.arange(min(count, 200)))
        assert (np.diff(found) >= 0).all()


def test_intervals_are_equal_in_time_and_not_in_frames() -> None:
    """With 90 frames in a second and 10 in the next, half of the intervals are in each second."""
    times = np.concatenate([np.arange(90) / 90, 1 + np.arange(10) / 10])
    found = intervals(times, 10)
    assert np.array_equal(found[:90], np.arange(90) // 18)
    assert np.array_equal(found[90:], 5 + np.arange(10) // 2)
    assert np.array_equal(intervals(np.arange(12.0), 4), np.arange(12) // 3)
    assert np.array_equal(intervals(np.zeros(6), 3), np.arange(6) // 2)


def test_repeats_are_told_from_slow_motion() -> None:
    random = np.random.default_rng(0)
    wide = np.asarray(Image.fromarray(random.integers(0, 255, (16, 30)).astype(np.uint8)).resize((480, 256)), float)
    noisy = [blocks((wide[:, :320] + random.normal(0, 1, (256, 320))).clip(0, 255).astype(np.uint8)) for _ in range(3)]
    moved = [blocks(wide[:, shift : 320 + shift].clip(0, 255).astype(np.uint8)) for shift in (2, 2, 4)]
    assert different([*noisy, *moved]).tolist() == [0, 3, 5]
    assert different([]).tolist() == []


def numbered(number: int) -> np.ndarray:
    """A frame (64, 64 BITS, 3) that shows its number in binary."""
    row = np.repeat([40 + 160 * (number >> bit & 1) for bit in range(BITS)], 64)
    return np.broadcast_to(row[None, :, None], (64, 64 * BITS, 3)).astype(np.uint8)


def number_of(picture: np.ndarray) -> int:
    return sum(int(picture[..., 0][:, 64 * bit + 20 : 64 * bit + 44].mean() > 120) << bit for bit in range(BITS))


def write_video(path: Path, numbers: list[int], times: str) -> None:
    """Write frames at times given as an expression of ffmpeg in seconds, with N, the frame's index."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    size = f"{64 * BITS}x64"
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", "30", "-i", "-"]
    uneven = ["-vf", f"settb=1/1000,setpts='({times})*1000'", "-fps_mode", "passthrough", "-enc_time_base", "1/1000"]
    command = [ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", *source, *uneven, "-c:v", "mpeg4", "-q:v", "2", str(path)]
    subprocess.run(command, input=b"".join(numbered(n).tobytes() for n in numbers), check=True)


@pytest.mark.medium
def test_frames_at_uneven_times_are_taken_as_they_are(tmp_path: Path) -> None:
    """40 frames in one second, a pause, then 20 frames in ten seconds."""
    write_video(tmp_path / "uneven.mp4", list(range(60)), "if(lt(N,40),N/40,3+(N-40)/2)")
    assert frame_count(tmp_path / "uneven.mp4") == 60
    times, numbers = survey(tmp_path / "uneven.mp4", lambda picture: number_of(picture[..., None]))
    assert numbers == list(range(60))
    assert np.abs(times - [n / 40 if n < 40 else 3 + (n - 40) / 2 for n in range(60)]).max() < 0.002
    assert [number_of(f) for f in chosen_frames(tmp_path / "uneven.mp4", np.array([3, 40, 59]))] == [3, 40, 59]

    names = write_frames(tmp_path / "uneven.mp4", tmp_path / "frames", 22)
    taken = [number_of(np.asarray(Image.open(tmp_path / "frames" / name))) for name in names]
    assert len(taken) == 22
    assert len(set(taken)) == 22
    assert taken == sorted(taken)
    assert sum(number >= 40 for number in taken) >= 18


@pytest.mark.medium
def test_repeats_are_dropped_and_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_video(tmp_path / "repeats.mp4", [n // 3 for n in range(30)], "N/30")
    assert len(write_frames(tmp_path / "repeats.mp4", tmp_path / "frames", 50)) == 10
    said = " ".join(capsys.readouterr().err.split())
    assert "30 frames" in said
    assert "20 of them repeat the one before and are dropped" in said
    assert "using all 10, fewer than --num-frames-target 50" in said


def test_a_colon_in_a_name_is_no_protocol(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_video(tmp_path / "plain.mp4", [1, 2, 3], "N/30")
    (tmp_path / "plain.mp4").rename(tmp_path / "12:30.mp4")
    monkeypatch.chdir(tmp_path)
    assert frame_count(Path("12:30.mp4")) == 3
    assert survey(Path("12:30.mp4"), lambda picture: number_of(picture[..., None]))[1] == [1, 2, 3]
    assert [number_of(f) for f in chosen_frames(Path("12:30.mp4"), np.array([1]))] == [2]


def test_what_a_video_holds_is_said() -> None:
    assert line(np.arange(4) / 2, 4, 2, 2) == "video: 4 frames in 1.5 s; using 2, the sharpest of each of 2 intervals"
    assert "at uneven times" in line(np.array([0, 1, 1.1, 1.2, 3]), 5, 2, 2)


def test_what_is_no_video_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg")
    with pytest.raises(DataError, match="there is no such file"):
        frame_count(tmp_path / "none.mp4")
    with pytest.raises(DataError, match="is a folder without a video"):
        frame_count(tmp_path)
    (tmp_path / "damaged.mp4").write_bytes(b"no video")
    with pytest.raises(DataError, match="not a readable video"):
        frame_count(tmp_path / "damaged.mp4")


@pytest.mark.parametrize("transfer", ["arib-std-b67", "smpte2084"])
def test_a_high_dynamic_range_is_mapped_to_the_standard_one(
    tmp_path: Path, transfer: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The colours of a picture of standard range come back; as stored they are grey."""
    ffmpeg = pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    colors = np.array([(255, 0, 0), (0, 255, 0), (0, 0, 255), (128, 128, 128)], np.uint8)
    picture = np.repeat(np.repeat(colors[None], 64, 0), 32, 1)
    to_hdr = f"zscale=pin=bt709:tin=bt709:min=gbr:rin=full:p=bt2020:t={transfer}:m=bt2020nc:r=tv:npl=203"
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", "128x64", "-i", "-"]
    tags = ["-color_primaries", "bt2020", "-color_trc", transfer, "-colorspace", "bt2020nc", "-color_range", "tv"]
    coded = ["-vf", f"{to_hdr},format=yuv420p10le", "-c:v", "ffv1", *tags, str(tmp_path / "hdr.mkv")]
    made = subprocess.run([ffmpeg, "-loglevel", "error", *raw, *coded], input=picture.tobytes(), check=False)
    if made.returncode:
        pytest.skip("this ffmpeg has no zscale")
    (found,) = chosen_frames(tmp_path / "hdr.mkv", np.array([0]))
    assert "tone-mapped" in capsys.readouterr().err
    middles = found[32, 16::32].astype(int)
    assert (middles[:3].argmax(-1) == np.arange(3)).all()
    assert (middles[:3].max(-1) > 170).all()
    assert (middles[:3].min(-1) < 70).all()
    assert np.ptp(middles[3]) < 10
    assert abs(middles[3] - 128).max() < 25
