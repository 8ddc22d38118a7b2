"""The viewer in headless Chromium, as a person uses it: the picture, the mouse, outputs, a path, and training."""

import json
import re
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from scipy.ndimage import binary_dilation, binary_erosion

from nerfloom.cameras.camera_path import read_camera_path
from nerfloom.cameras.view import View
from nerfloom.runs import load
from nerfloom.training.trained import load_trained
from nerfloom.viewer.request import Pose, Request
from tests.cli.helpers import TINY_NGP, command, train
from tests.conftest import write_tiny
from tests.patience import PATIENCE, until
from tests.training.helpers import tiny_trainer
from tests.viewer.chromium import Chromium, Tab, chromium

pytest.importorskip("viser", reason="the extra [viewer] is not installed")
pytestmark = pytest.mark.slow
PICTURE = np.s_[200:520, 60:540]
"""Rows and columns of the page beside the panel and below the note that WebGL is slow here."""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    with chromium(tmp_path_factory.mktemp("chromium")) as found:
        yield found


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, shared_tiny: Path) -> Path:
    return train(shared_tiny, tmp_path_factory.mktemp("runs"), "--max-num-iterations", 300)


@contextmanager
def started(*words: object) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A command that serves the viewer, and its address."""
    process = subprocess.Popen([*map(str, words)], stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    address = ""
    for line in process.stderr:
        if found := re.search(r"viewer: (http://\S+)", line):
            address = found[1]
            break
    assert address, "the command ended before it served anything"
    try:
        yield process, address
    finally:
        process.terminate()
        process.communicate(timeout=PATIENCE)


def settled(tab: Tab, seconds: float = 180.0) -> np.ndarray:
    """The page when it has stopped changing."""
    end, before = time.monotonic() + seconds, tab.screenshot()
    while time.monotonic() < end:
        time.sleep(1.5)
        now = tab.screenshot()
        if np.array_equal(now, before) and now[150:500, 50:500].std() > 5:
            return now
        before = now
    raise AssertionError("the page did not come to rest")


def shown(tab: Tab) -> np.ndarray:
    """The picture at rest."""
    return settled(tab)[PICTURE].astype(float)


def expected(run: Path, tab: Tab, camera: list[float], time: float | None = None) -> np.ndarray:
    """What the run's model renders from the page's camera: position, target and up."""
    width, height = tab.evaluate("(c => [c.clientWidth, c.clientHeight])(document.querySelector('canvas'))")
    position, target, up = (torch.tensor(camera[i : i + 3], dtype=torch.float64) for i in (0, 3, 6))
    back = torch.nn.functional.normalize(position - target, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(up, back), dim=0)
    matrix = torch.stack([right, torch.linalg.cross(back, right), back, position], 1)
    model = load_trained(run, device_type="cpu").model
    request = Request(Pose(tuple(matrix.flatten().tolist()), np.radians(50)), width, height, time=time)
    picture = model.render_view(View(request.camera(), time=time), model.background)
    return picture.rgb.clamp(0, 1).numpy()[PICTURE] * 255


def decibels(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / (np.square(a - b).mean() + 1e-6)))


def choose(tab: Tab, label: str, option: str) -> None:
    """Choose an option of a list, which is the input beside its label."""
    script = f"""(() => {{
      const found = [...document.querySelectorAll("label")].filter(e => e.textContent.trim() === {json.dumps(label)});
      const row = found[0].parentElement.parentElement;
      const box = (document.getElementById(found[0].htmlFor) || row.querySelector("input")).getBoundingClientRect();
      return [box.x + box.width / 2, box.y + box.height / 2];
    }})()"""
    tab.click(*tab.evaluate(script))
    time.sleep(0.5)
    tab.press(option)


def to_the_end(tab: Tab) -> None:
    """Press End on the first slider, which is that of time where there is one."""
    tab.evaluate("document.querySelector('[role=slider]').focus()")
    for kind in ("keyDown", "keyUp"):
        tab.send("Input.dispatchKeyEvent", type=kind, key="End", code="End", windowsVirtualKeyCode=35)


def type_into(tab: Tab, label: str, index: int, text: str) -> None:
    """Replace what one of the fields beside a label holds, as the keyboard does."""
    script = f"""(() => {{
      const found = [...document.querySelectorAll("label")].filter(e => e.textContent.trim() === {json.dumps(label)});
      const first = document.getElementById(found[0].htmlFor).closest(".mantine-NumberInput-root");
      const field = first.parentElement.querySelectorAll("input")[{index}];
      field.focus();
      field.select();
    }})()"""
    tab.evaluate(script)
    tab.send("Input.insertText", text=text)


def tick(tab: Tab, label: str) -> None:
    """Click the box beside a label, when it has come to rest: a folder opens slowly."""
    script = f"""(() => {{
      const found = [...document.querySelectorAll("label")].filter(e => e.textContent.trim() === {json.dumps(label)});
      const box = document.getElementById(found[0].htmlFor).getBoundingClientRect();
      return [box.x + box.width / 2, box.y + box.height / 2];
    }})()"""
    places = [[], tab.evaluate(script)]
    while places[-2] != places[-1]:
        time.sleep(0.3)
        places.append(tab.evaluate(script))
    tab.click(*places[-1])


def meets_box(tab: Tab, camera: list[float], low: Sequence[float], high: Sequence[float]) -> np.ndarray:
    """Which rays of the page's picture meet a box: slabs, in float64, independent of what the viewer does."""
    width, height = tab.evaluate("(c => [c.clientWidth, c.clientHeight])(document.querySelector('canvas'))")
    position, target, up = (np.array(camera[i : i + 3]) for i in (0, 3, 6))
    ahead = (target - position) / np.linalg.norm(target - position)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    focal = 0.5 * height / np.tan(np.radians(25))
    across = (np.arange(width) + 0.5 - width / 2) / focal
    down = (np.arange(height) + 0.5 - height / 2) / focal
    rays = ahead + across[None, :, None] * right + down[:, None, None] * np.cross(ahead, right)
    sides = (np.array([low, high])[:, None, None] - position) / rays
    enter, leave = sides.min(0).max(-1), sides.max(0).min(-1)
    return (leave > np.maximum(enter, 0))[PICTURE]


def look_of(run: Path) -> list[float]:
    """The camera that the page begins with: position, target and up."""
    camera = load_trained(run, device_type="cpu").model.scene.camera_to_worlds
    assert camera is not None
    position, back = camera[0, :, 3], camera[0, :, 2]
    return [*position.tolist(), *(position - back).tolist(), 0.0, 0.0, 1.0]


def test_a_trained_run(browser: Chromium, run: Path, tmp_path: Path) -> None:
    with started(command("ns-viewer"), run, "--websocket-port", 17107) as (process, address):
        tab = browser.open(address)
        first = shown(tab)
        found = decibels(first, expected(run, tab, look_of(run)))
        print(f"the page's picture against the model's: {found:.1f} dB")
        assert found > 30

        tab.drag((300, 400), (420, 380))
        assert decibels(shown(tab), first) < 25  # the mouse has moved the camera

        before = shown(tab)
        choose(tab, "Output", "depth")
        assert decibels(shown(tab), before) < 20
        choose(tab, "Output", "rgb")
        assert decibels(shown(tab), before) > 40

        tab.press("Path")
        tab.press("Add this camera")
        tab.drag((300, 400), (420, 380))
        time.sleep(1)
        tab.press("Add this camera")
        time.sleep(1)
        tab.press("Save")
        file = run / "camera_path.json"
        until(file.is_file)
        path = read_camera_path(file)
        assert len(path.keyframes) == 2
        assert float((path.poses[0] - path.poses[-1]).abs().max()) > 0.1
        tab.press("Save and render")
        until(lambda: next(run.glob("camera_path.*[!n]"), None))
        tab.screenshot(tmp_path / "path.png")

        other = browser.open(address)
        shown(other)
        tab.close()
        other.drag((300, 400), (350, 380))
        shown(other)
        other.close()
        assert process.poll() is None


def test_crop(browser: Chromium, run: Path) -> None:
    """What is outside of the box is gone from the page, and what is inside is as it was."""
    with started(command("ns-viewer"), run, "--websocket-port", 17407) as (_, address):
        tab = browser.open(address)
        whole = shown(tab)
        tab.press("Crop")
        tick(tab, "Crop")
        type_into(tab, "Highest corner", 2, "0")  # the upper half of the ball is cut away
        time.sleep(1)
        cut = shown(tab)
        low, high = load_trained(run, device_type="cpu").model.scene.box.double().tolist()
        inside = meets_box(tab, look_of(run), low, [*high[:2], 0.0])
        tab.close()
    # JPEG's blocks of 8 pixels carry errors across the edge of the box.
    near_edge = binary_dilation(inside, iterations=9) & ~binary_erosion(inside, iterations=9)
    outside, inside = ~inside & ~near_edge, inside & ~near_edge
    matter, left = (np.abs(picture - 255).max(-1) > 40 for picture in (whole, cut))  # the background is white
    print(f"matter outside of the box: {matter[outside].mean():.3f} before, {left[outside].mean():.5f} after")
    print(f"matter inside: {matter[inside].mean():.3f} before, {left[inside].mean():.3f} after")
    assert matter[outside].mean() > 0.1
    assert left[outside].mean() == 0
    assert left[inside].mean() > 0.1


def test_measuring(browser: Chromium, run: Path, tmp_path: Path) -> None:
    """Two clicks on the ball, its scale, and the length in it."""
    places = (330, 380), (430, 300)
    with started(command("ns-viewer"), run, "--websocket-port", 17507) as (_, address):
        tab = browser.open(address)
        shown(tab)
        width, height = tab.evaluate("(c => [c.clientWidth, c.clientHeight])(document.querySelector('canvas'))")
        tab.press("Measure")
        tick(tab, "Pick points")
        until(lambda: "first point" in tab.evaluate("document.body.innerText"))
        tab.click(*places[0])
        until(lambda: "second point" in tab.evaluate("document.body.innerText"))
        tab.click(*places[1])
        length = r"(\d+\.\d+) (± \d|\(error unknown)"  # two cameras may not agree on so coarse a ball
        found = until(lambda: re.search(length, tab.evaluate("document.body.innerText")))
        time.sleep(1)
        picture = tab.screenshot(tmp_path / "measure.png")
        tab.press("Set the scale")
        time.sleep(1)
        tab.press("Set scale")
        file = run / "scale.json"
        until(file.is_file)
        scale = json.loads(file.read_text())
        file.unlink()
        scaled = until(lambda: re.search(r"\b1(\.0+)? m (±|\()", tab.evaluate("document.body.innerText")))
        tab.screenshot(tmp_path / "scaled.png")
        tab.close()
    loaded = load(run, device="cpu")
    position, target, up = (torch.tensor(look_of(run)[i : i + 3], dtype=torch.float64) for i in (0, 3, 6))
    back = torch.nn.functional.normalize(position - target, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(up, back), dim=0)
    pose = Pose(tuple(torch.stack([right, torch.linalg.cross(back, right), back, position], 1).flatten().tolist()),
                np.radians(50))  # fmt: skip
    view = View(Request(pose, width, height).camera())
    ends = [loaded.pick(view, x - 0.5, y - 0.5) for x, y in places]
    expected = loaded.measure(*ends)
    print(f"on the page: {found[0]}; in Python: {expected}; with the scale: {scaled[0]}")
    assert float(found[1]) == pytest.approx(expected.value, rel=0.02)  # the page's pixels are not the window's
    assert scale["unit"] == "m"
    assert scale["factor"] == pytest.approx(1 / expected.value, rel=0.02)
    assert int((np.abs(picture[PICTURE].astype(int) - [255, 190, 0]).max(-1) < 60).sum()) > 100  # the line is drawn


@pytest.fixture
def blue_with_time(tmp_path: Path) -> Path:
    """A K-Planes run of a ball whose blue grows from none to full while the camera circles."""
    data = write_tiny(tmp_path / "ball", counts=(20, 2, 2))
    for split in ("train", "val", "test"):
        file = data / f"transforms_{split}.json"
        content = json.loads(file.read_text())
        for index, frame in enumerate(content["frames"]):
            frame["time"] = index / (len(content["frames"]) - 1)
            picture = data / f"{frame['file_path']}.png"
            rgba = iio.imread(picture)
            rgba[..., 2] = (rgba[..., 3] * frame["time"]).astype(np.uint8)
            iio.imwrite(picture, rgba)
        file.write_text(json.dumps(content))
    trainer = tiny_trainer("kplanes", data, tmp_path / "run", max_num_iterations=200)
    trainer.train()
    return trainer.folder


def test_time(browser: Chromium, blue_with_time: Path) -> None:
    run = blue_with_time
    with started(command("ns-viewer"), run, "--websocket-port", 17307) as (_, address):
        tab = browser.open(address)
        assert decibels(shown(tab), expected(run, tab, look_of(run), 0.0)) > 30
        to_the_end(tab)
        late = shown(tab)
        assert decibels(late, expected(run, tab, look_of(run), 1.0)) > 30
        assert decibels(late, expected(run, tab, look_of(run), 0.0)) < 28  # what was learnt changes with time
        tab.close()


def test_a_run_in_training(browser: Chromium, shared_tiny: Path, tmp_path: Path) -> None:
    words = ["--data", shared_tiny, "--output-dir", tmp_path, "--timestamp", "t", *TINY_NGP]
    words += ["--vis", "viewer", "--viewer.websocket-port", 17207, "--max-num-iterations", 10**6]
    with started(command("ns-train"), "instant-ngp", *words) as (process, address):
        tab = browser.open(address)

        def step() -> int:
            found = re.search(r"step ([\d,]+) · \d+ s", tab.evaluate("document.body.innerText"))
            return int(found[1].replace(",", "")) if found else 0

        until(lambda: tab.screenshot()[PICTURE].std() > 5)
        before = until(step)
        until(lambda: step() > before)
        tab.press("Pause training")
        time.sleep(2)
        paused = step()
        time.sleep(2)
        assert step() == paused
        tab.press("Continue training")
        until(lambda: step() > paused)
        tab.close()
        assert process.poll() is None
