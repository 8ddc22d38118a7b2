"""Shared by the tests: a tiny data set, tiny settings, and where real data is."""

import gc
import itertools
import json
import math
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

# Threads that spin while they wait make a step fifty times slower where the cores are shared. Read when torch loads.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, settings

from tests.forked import Forks

# Processes of tests share the cores (pytest -n auto), and small tensors gain nothing by a second thread. Tests that are
# about threads ask for them.
torch.set_num_threads(1)

# Hypothesis looks at a clock twice, and a busy machine would fail its tests.
settings.register_profile("without a clock", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("without a clock")


def pytest_configure() -> None:
    """Imported and collected objects stay: looking for garbage among them would take a third of the time."""
    gc.disable()


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    """Only objects of tests are looked through from here on."""
    gc.collect()
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def _cache(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> None:
    """Generated data goes to a folder of this test session, not to the user's cache. Its processes share it."""
    folder = tmp_path_factory.getbasetemp()
    if hasattr(request.config, "workerinput"):  # each process of pytest-xdist has a folder within the session's
        folder = folder.parent
    (folder / "cache").mkdir(exist_ok=True)
    os.environ["NERFLOOM_CACHE"] = str(folder / "cache")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real photographs; tests that need it are skipped without."""
    folder = os.environ.get("NERFLOOM_DATA")
    if not folder:
        pytest.skip("NERFLOOM_DATA is not set: it names the folder of real photographs")
    return Path(folder)


def ball_view(azimuth: float, size: int) -> tuple[np.ndarray, list[list[float]]]:
    """A ball of radius 1, coloured by its normal, seen from distance 4: RGBA (size, size, 4) and the pose (4, 4)."""
    back = np.array([math.cos(azimuth), math.sin(azimuth), 0.3])
    back /= np.linalg.norm(back)
    right = np.cross([0, 0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, 4 * back], axis=1)
    focal = 0.5 * size / math.tan(0.35)
    rows, columns = np.mgrid[:size, :size] + 0.5
    local = np.stack([(columns - size / 2) / focal, -(rows - size / 2) / focal, -np.ones_like(rows)], -1)
    directions = local @ pose[:3, :3].T
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    nearest = -(directions @ pose[:3, 3])
    miss2 = 16 - nearest**2
    hit = miss2 < 1
    points = pose[:3, 3] + (nearest - np.sqrt(np.clip(1 - miss2, 0, None)))[..., None] * directions
    rgba = np.concatenate([0.5 + 0.5 * points, hit[..., None]], -1) * hit[..., None]
    return (rgba * 255).round().astype(np.uint8), pose.tolist()


def write_tiny(folder: Path, size: int = 20, counts: tuple[int, int, int] = (10, 2, 3)) -> Path:
    """A Blender-format data set of a ball."""
    for split, count in zip(("train", "val", "test"), counts, strict=True):
        (folder / split).mkdir(parents=True)
        frames = []
        for index in range(count):
            image, pose = ball_view(2 * math.pi * (index + 0.1 * len(split)) / count, size)
            iio.imwrite(folder / split / f"r_{index}.png", image)
            frames.append({"file_path": f"./{split}/r_{index}", "transform_matrix": pose})
        content = {"camera_angle_x": 0.7, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content))
    return folder


@pytest.fixture
def tiny(shared_tiny: Path, tmp_path: Path) -> Path:
    """A fresh tiny data set that a test may damage."""
    return shutil.copytree(shared_tiny, tmp_path / "ball")


@pytest.fixture(scope="session")
def shared_tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny data set that tests only read."""
    return write_tiny(tmp_path_factory.mktemp("data") / "ball")


@pytest.fixture(scope="session")
def forks() -> Iterator[Forks]:
    """Runs programs in separate processes that have imported torch already."""
    found = Forks()
    yield found
    found.close()


EditJson = Callable[[Callable[[dict[str, Any]], Any]], None]


@pytest.fixture
def edit_json(tiny: Path) -> EditJson:
    """Change the tiny data set's transforms_train.json in place."""

    def edit(change: Callable[[dict[str, Any]], Any]) -> None:
        file = tiny / "transforms_train.json"
        content = json.loads(file.read_text())
        change(content)
        file.write_text(json.dumps(content))

    return edit


TICK = 0.01
"""Seconds between two looks at the `even_clock`."""


@pytest.fixture
def even_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock that budgets go by, a tick later each time it is looked at, however busy the machine is."""
    looks = itertools.count()
    monkeypatch.setattr(time, "perf_counter", lambda: next(looks) * TICK)


@pytest.fixture
def two_threads() -> Iterator[None]:
    """Torch and the kernels share their work out over two threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


Refused = Callable[..., str]


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Refused:
    """Run a command's `main` on bad arguments; returns the one line that answers them.

    The exit status is 1, or 2 where it is the flags themselves that are wrong.
    """

    def run(main: Callable[[], None], *arguments: object, status: int = 1) -> str:
        monkeypatch.setattr(sys, "argv", ["command", *map(str, arguments)])
        with pytest.raises(SystemExit) as end:
            main()
        said = capsys.readouterr().err
        assert end.value.code == status
        assert "Traceback" not in said
        last = said.strip().splitlines()[-1]
        assert last.startswith("error: ")
        return last

    return run


@pytest.fixture
def ctrl_c_raises() -> Iterator[None]:
    """Handle Ctrl-C as in a terminal; a shell makes programs in the background ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
