"""Sets larger than memory may hold: decoded once, whole or not at all, and found again."""

import errno
import io
import os
import signal
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from nerfloom.base.config import TrainConfig
from nerfloom.base.device import machine_memory
from nerfloom.base.errors import ConfigError, DataError
from nerfloom.data.dataset import Dataset, load_dataset
from nerfloom.data.image_files import read_image
from nerfloom.data.parsed_scene import ParsedScene
from nerfloom.data.pixels.cache import MAGIC, PixelMemory, unpack
from nerfloom.data.pixels.store import FileStore
from tests.forked import Forks, Program
from tests.images import noise, parsed, write_noise

SIZES = [(40, 30), (17, 23), (64, 48), (31, 31)]


@pytest.fixture
def scene(tmp_path: Path) -> ParsedScene:
    return write_noise(tmp_path / "images", SIZES)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "cache"


def cached(scene: ParsedScene, folder: Path) -> Dataset:
    return load_dataset(scene, "train", PixelMemory(0, folder))


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_cached_set_is_the_set(scene: ParsedScene, folder: Path) -> None:
    here, there = load_dataset(scene, "train"), cached(scene, folder)
    assert here.mapped is None
    assert there.mapped is not None
    assert torch.equal(here.pixels, there.pixels)
    for index, size in enumerate(SIZES):
        assert np.array_equal(there.image(index).numpy(), noise(*size, index))
    assert there.names == here.names
    assert there.light is not None
    assert here.light is not None
    assert torch.equal(here.light, there.light)
    assert len(files(folder)) == 1


def test_a_later_run_decodes_nothing_and_says_so(
    scene: ParsedScene, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    first = cached(scene, folder)
    assert "decoding them once into" in capsys.readouterr().err.replace("\n", " ")
    monkeypatch.setattr("nerfloom.data.decoding.read_image", lambda *_: pytest.fail("decoded again"))
    second = cached(scene, folder)
    assert "using decoded pixels of an earlier run" in capsys.readouterr().err.replace("\n", " ")
    assert torch.equal(first.pixels, second.pixels)


def test_a_changed_image_or_another_reduction_is_another_file(scene: ParsedScene, folder: Path) -> None:
    from dataclasses import replace

    cached(scene, folder)
    iio.imwrite(scene.image_paths[1], noise(17, 23, 99))
    assert np.array_equal(cached(scene, folder).image(1).numpy(), noise(17, 23, 99))
    assert cached(replace(scene, downscale_factor=2), folder).image(0).shape == (15, 20, 3)
    assert len(files(folder)) == 3


@pytest.mark.parametrize("limit", [0.0, 1e9])
def test_what_cannot_be_read_leaves_no_gap(
    scene: ParsedScene, folder: Path, limit: float, capsys: pytest.CaptureFixture[str]
) -> None:
    scene.image_paths[1].write_bytes(b"no image")
    for _ in range(2):  # decoded, and (where it is cached) found again
        data = load_dataset(scene, "train", PixelMemory(limit, folder))
        assert data.names == ("000.bmp", "002.bmp", "003.bmp")
        for index, original in enumerate((0, 2, 3)):
            assert np.array_equal(data.image(index).numpy(), noise(*SIZES[original], original))
        said = " ".join(capsys.readouterr().err.split())
        assert "1 of 4 images are unreadable and skipped" in said
        assert "001.bmp" in said


@pytest.mark.parametrize("limit", [0.0, 1e9])
@pytest.mark.parametrize("opaque", [True, False])
def test_alpha_that_says_nothing_is_left_out(tmp_path: Path, folder: Path, limit: float, opaque: bool) -> None:
    paths = [tmp_path / f"{index}.png" for index in range(3)]
    images = [noise(50, 40, index, 4) for index in range(3)]
    for path, image in zip(paths, images, strict=True):
        image[..., 3] = 255
        if path is paths[-1] and not opaque:
            image[7, 8, 3] = 254
        iio.imwrite(path, image)
    data = load_dataset(parsed(paths, [(50, 40)] * 3), "train", PixelMemory(limit, folder))
    assert data.scene.has_alpha is not opaque
    for index, image in enumerate(images):
        assert np.array_equal(data.image(index).numpy(), image[..., : 3 if opaque else 4])


def full(*_: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("when", ["at once", "while decoding", "at the end"])
def test_a_full_disk_is_an_error_that_says_how_much_is_needed_where(
    scene: ParsedScene, folder: Path, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    if when == "at once":
        monkeypatch.setattr(os, "posix_fallocate", full, raising=False)
    else:
        monkeypatch.setattr(FileStore, "write" if when == "while decoding" else "finish", full)
    expected = rf"cannot write decoded pixels: 0 MB are needed in {folder}, where [\d,]+ MB are free .*--cache-dir"
    with pytest.raises(DataError, match=expected):
        cached(scene, folder)
    assert files(folder) == []


def test_a_folder_that_cannot_be_made(scene: ParsedScene, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(DataError, match="cannot write decoded pixels"):
        cached(scene, tmp_path / "file" / "cache")


def test_an_error_leaves_no_file(scene: ParsedScene, folder: Path) -> None:
    iio.imwrite(scene.image_paths[2], noise(10, 10, 0))
    with pytest.raises(DataError, match=r"002\.bmp is 10x10 pixels, .* 64x48"):
        cached(scene, folder)
    assert files(folder) == []


KILLED = """
import os, signal, sys
from pathlib import Path
from nerfloom.data.dataset import load_dataset
from nerfloom.data.pixels.cache import PixelMemory
from nerfloom.data.pixels.store import FileStore
from tests.images import parsed
if sys.argv[3] == "killed":
    FileStore.finish = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
paths = sorted(Path(sys.argv[1]).iterdir())
load_dataset(parsed(paths, [(40, 30), (17, 23), (64, 48), (31, 31)]), "train", PixelMemory(0, Path(sys.argv[2])))
"""


def other_process(scene: ParsedScene, folder: Path, kind: str) -> Program:
    """A program that decodes the scene into the folder."""
    return KILLED, [scene.image_paths[0].parent, folder, kind], {}


@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
def test_a_killed_run_leaves_nothing_that_is_used_and_is_cleaned_up_after(
    scene: ParsedScene, folder: Path, forks: Forks
) -> None:
    (killed,) = forks.together(other_process(scene, folder, "killed"))
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    assert [name[:8] for name in files(folder)] == [".pixels-"]
    assert torch.equal(cached(scene, folder).pixels, load_dataset(scene, "train").pixels)
    assert [name[:7] for name in files(folder)] == ["pixels-"]


def test_two_processes_may_write_at_once(scene: ParsedScene, folder: Path, forks: Forks) -> None:
    both = forks.together(*[other_process(scene, folder, "whole")] * 2)
    assert [process.returncode for process in both] == [0, 0], both
    assert len(files(folder)) == 1
    assert torch.equal(cached(scene, folder).pixels, load_dataset(scene, "train").pixels)


@pytest.mark.parametrize("damage", ["cut short", "other ending", "empty"])
def test_a_damaged_file_is_not_used(scene: ParsedScene, folder: Path, damage: str) -> None:
    cached(scene, folder)
    path = next(folder.iterdir())
    content = path.read_bytes()
    path.write_bytes({"cut short": content[:-100], "other ending": content[:-1] + b"?", "empty": b""}[damage])
    assert torch.equal(cached(scene, folder).pixels, load_dataset(scene, "train").pixels)
    assert path.read_bytes() == content


def test_a_byte_of_the_ending_that_changed(scene: ParsedScene, folder: Path) -> None:
    """It is noticed, or means nothing, as some of a zip file's do."""
    cached(scene, folder)
    path, pixels = next(folder.iterdir()), sum(width * height for width, height in SIZES)
    content = path.read_bytes()
    for place in range(3 * pixels, len(content), 11):
        path.write_bytes(content[:place] + bytes([content[place] ^ 0x55]) + content[place + 1 :])
        found = unpack(path)
        if found is not None:
            assert (int(found["pixels"]), int(found["channels"]), found["left"].tolist()) == (pixels, 3, [0, 1, 2, 3])


def test_an_ending_that_would_unfold_to_more_than_it_holds_is_not_read(scene: ParsedScene, folder: Path) -> None:
    cached(scene, folder)
    path, ending = next(folder.iterdir()), io.BytesIO()
    facts = unpack(path)
    assert facts is not None
    np.savez_compressed(ending, **facts, more=np.zeros(10**6))
    size = int(facts["pixels"]) * int(facts["channels"])
    values = ending.getvalue()
    path.write_bytes(path.read_bytes()[:size] + values + len(values).to_bytes(8, "little") + MAGIC)
    assert unpack(path) is None


MEASURE = """
import sys, threading
from pathlib import Path
import torch
from nerfloom.data.dataset import load_dataset
from nerfloom.data.pixels.cache import PixelMemory
from nerfloom.data.pixels.stream import PixelStream
from nerfloom.data.pixels.batch import draw_batch
from nerfloom.base.device import seed_step
from tests.images import parsed

def status(name):
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name + ":")) / 1e3

def peak_of(work):
    Path("/proc/self/clear_refs").write_text("5")  # the peak is counted from here
    before = status("VmRSS")
    result = work()
    return result, status("VmHWM") - before

def train(data, steps):
    stream = None if data.mapped is None else PixelStream(data, 0)
    for step in range(steps):
        seed_step(0, step)
        look_up = None if stream is None else (lambda flat: stream.look_up(step, flat))
        batch = draw_batch(data, 1000 + 10 * step, "black", look_up=look_up)
        data.image(step % len(data)).max()

torch.set_num_threads(1)
paths, memory = sorted(Path(sys.argv[1]).iterdir()), PixelMemory(float(sys.argv[3]), Path(sys.argv[2]))
sizes = [(500, 500)] * len(paths)
train(load_dataset(parsed(paths[:3], sizes[:3]), "train", memory), 150)
data, loading = peak_of(lambda: load_dataset(parsed(paths, sizes), "train", memory))
_, training = peak_of(lambda: train(data, 150))
print(loading, training)
"""


@pytest.fixture(scope="module")
def many_images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of images with 60 MB of pixels."""
    folder = tmp_path_factory.mktemp("many") / "images"
    write_noise(folder, [(500, 500)] * 80)
    return folder


@pytest.mark.parametrize(("limit", "least", "most"), [(10e6, 0, 30), (1e9, 60, 90)])
def test_memory_stays_bounded(
    many_images: Path, tmp_path: Path, limit: float, least: float, most: float, forks: Forks
) -> None:
    """60 MB of pixels, read at random for 150 batches: under a limit of 10 MB, and all in memory."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        pytest.skip("this system does not tell the peak of a process's memory")
    done = forks.run(MEASURE, many_images, tmp_path / "cache", limit)
    assert done.returncode == 0, done.stderr
    loading, training = map(float, done.stdout.split())
    print(f"limit {limit / 1e6:.0f} MB: loading took {loading:.1f} MB more, training {training:.1f}")
    assert least <= loading < most  # the set, or a part of it, and the images being decoded
    assert training < 15


def test_reading_in_bands_reduces_as_before(tmp_path: Path) -> None:
    image = noise(31, 700, 0, 4)
    iio.imwrite(tmp_path / "a.png", image)
    found = read_image(tmp_path / "a.png", 3)
    blocks = image[:699, :30].reshape(233, 3, 10, 3, 4).astype(np.float64)
    alpha = blocks[..., 3:].sum((1, 3))
    color = (blocks[..., :3] * blocks[..., 3:]).sum((1, 3)) / np.maximum(alpha, 1)
    assert np.array_equal(found, np.concatenate([color, alpha / 9], -1).round().astype(np.uint8))


@pytest.mark.parametrize("limit", [-1.0, float("nan")])
def test_a_limit_below_nothing_is_refused(limit: float) -> None:
    with pytest.raises(ConfigError, match=r"--cache-limit is .*; it must be at least 0 MB"):
        TrainConfig(cache_limit=limit)


def test_without_a_limit_half_of_the_memory_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert 0 < PixelMemory.of().limit == machine_memory() / 2
    assert PixelMemory.of(3.0, tmp_path) == PixelMemory(3e6, tmp_path)
    monkeypatch.delenv("NERFLOOM_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert PixelMemory.of().folder == tmp_path / "nerfloom"


def test_a_user_without_a_home_is_told_how_to_name_a_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("NERFLOOM_CACHE", "XDG_CACHE_HOME", "HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os, "getuid", lambda: 4_000_000_001, raising=False)  # no user's number
    with pytest.raises(ConfigError, match="no home folder: set the variable NERFLOOM_CACHE"):
        PixelMemory.of()
