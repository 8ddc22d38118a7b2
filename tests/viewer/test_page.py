"""The viewer in headless Chromium, as a person uses it: the picture, the mouse, outputs, a path, and training."""

import json
import re
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
from tests.cli.helpers import TINY_NGP, command
from tests.conftest import write_tiny
from tests.patience import until
from tests.training.helpers import tiny_trainer
from tests.viewer.chromium import Chromium, Tab
from tests.viewer.pages import (
    PICTURE,
    choose,
    decibels,
    expected,
    look_of,
    meets_box,
    settled,
    shown,
    shown_like,
    shown_unlike,
    size_of,
    started,
    text_of,
    tick,
    to_the_end,
    type_into,
    type_text,
)

pytest.importorskip("viser", reason="the extra [viewer] is not installed")
pytestmark = pytest.mark.slow


def test_a_trained_run(browser: Chromium, run: Path, tmp_path: Path) -> None:
    with started(command("ns-viewer"), run, "--websocket-port", 17107) as (process, address):
        tab = browser.open(address)
        shown(tab)
        first = shown_like(tab, expected(run, tab, look_of(run)))

        tab.drag((300, 400), (420, 380))
        shown_unlike(tab, first)  # the mouse has moved the camera

        before = shown(tab)
        choose(tab, "Output", "depth")
        shown_unlike(tab, before, 20)
        choose(tab, "Output", "rgb")
        shown_like(tab, before, 40)

        tab.press("Path")
        tab.press("Add this camera")
        tab.drag((300, 400), (420, 380))
        tab.pause()
        tab.press("Add this camera")
        tab.pause()
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


def share_of_matter(tab: Tab) -> float:
    """The share of the picture at rest that is not the white background."""
    return float((np.abs(settled(tab, least=-1)[PICTURE].astype(int) - 255).max(-1) > 40).mean())


def test_crop(browser: Chromium, run: Path) -> None:
    """The outside of the box is gone from the page, and the inside is unchanged; so is what is too near or too far."""
    with started(command("ns-viewer"), run, "--websocket-port", 17407) as (_, address):
        tab = browser.open(address)
        whole = shown(tab)
        tab.press("Crop")
        tick(tab, "Crop")
        tick(tab, "Show the box")  # its lines would count as matter
        type_into(tab, "Highest corner", 2, "0")  # the upper half of the ball is cut away
        tab.pause()
        cut = shown_unlike(tab, whole, 60)
        matter, left = (np.abs(picture - 255).max(-1) > 40 for picture in (whole, cut))  # the background is white
        low, high = load_trained(run, device_type="cpu").model.scene.box.double().tolist()
        inside = meets_box(tab, look_of(run), low, [*high[:2], 0.0])
        type_into(tab, "Lowest corner", 2, "-0.001")
        tab.pause()
        until(lambda: share_of_matter(tab) < 0.2 * left.mean())  # a thin slice
        type_into(tab, "Lowest corner", 2, str(low[2]))
        away = float(np.linalg.norm(look_of(run)[:3]))
        # The ball is between 0.75 and 1.25 of the camera's distance.
        for near, far, least, most in ((0, 0.7, 0, 0.01), (1.3, 3, 0, 0.01), (0, 3, 0.95, 1.05)):
            type_into(tab, "Near", 0, f"{near * away:.2f}")
            type_into(tab, "Far", 0, f"{far * away:.2f}")
            tab.pause()
            share = left.mean() if least else 1.0
            until(lambda share=share, least=least, most=most: least <= share_of_matter(tab) / share <= most)
        tab.close()
    # JPEG's blocks of 8 pixels carry errors across the edge of the box.
    near_edge = binary_dilation(inside, iterations=9) & ~binary_erosion(inside, iterations=9)
    outside, inside = ~inside & ~near_edge, inside & ~near_edge
    print(f"matter outside of the box: {matter[outside].mean():.3f} before, {left[outside].mean():.5f} after")
    print(f"matter inside: {matter[inside].mean():.3f} before, {left[inside].mean():.3f} after")
    assert matter[outside].mean() > 0.1
    assert left[outside].mean() == 0
    assert left[inside].mean() > 0.1


def line_pixels(tab: Tab) -> int:
    """How many pixels of the page have the colour of the line between two points."""
    return int((np.abs(tab.screenshot()[PICTURE].astype(int) - [255, 190, 0]).max(-1) < 60).sum())


def test_measuring(browser: Chromium, run: Path, tmp_path: Path) -> None:
    """Two clicks on the ball, its scale, and the length in it."""
    places = (330, 380), (430, 300)
    with started(command("ns-viewer"), run, "--websocket-port", 17507) as (_, address):
        tab = browser.open(address)
        shown(tab)
        width, height = size_of(tab)
        tab.press("Measure")
        tick(tab, "Pick points")
        until(lambda: "first point" in text_of(tab))
        tab.click(*places[0])
        until(lambda: "second point" in text_of(tab))
        tab.click(*places[1])
        length = r"(\d+\.\d+) (± \d|\(error unknown)"  # two cameras may not agree on so coarse a ball
        found = until(lambda: re.search(length, text_of(tab)))
        until(lambda: line_pixels(tab) > 100)
        tab.screenshot(tmp_path / "measure.png")
        tab.press("Set the scale")
        tab.pause()
        type_into(tab, "True length", 0, "20")
        type_text(tab, "Unit", "cm")
        tab.press("Set scale")
        file = run / "scale.json"
        until(file.is_file)
        scale = json.loads(file.read_text())
        file.unlink()
        scaled = until(lambda: re.search(r"\b20(\.0+)? cm (±|\()", text_of(tab)))
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
    assert scale["unit"] == "cm"
    assert scale["factor"] == pytest.approx(20 / expected.value, rel=0.02)


@pytest.fixture
def blue_with_time(tmp_path: Path) -> Path:
    """A K-Planes run of a ball with blue that grows from none to full while the camera circles seven times.

    After one circle, blue might belong to the side of the ball instead of the time.
    """
    data = write_tiny(tmp_path / "ball", counts=(20, 2, 2))
    for split in ("train", "val", "test"):
        file = data / f"transforms_{split}.json"
        content = json.loads(file.read_text())
        for index, frame in enumerate(content["frames"]):
            frame["time"] = 7 * index % len(content["frames"]) / (len(content["frames"]) - 1)
            picture = data / f"{frame['file_path']}.png"
            rgba = iio.imread(picture)
            rgba[..., 2] = (rgba[..., 3] * frame["time"]).astype(np.uint8)
            iio.imwrite(picture, rgba)
        file.write_text(json.dumps(content))
    trainer = tiny_trainer("kplanes", data, tmp_path / "run", max_num_iterations=400)
    trainer.train()
    return trainer.folder


def test_time(browser: Chromium, blue_with_time: Path) -> None:
    run = blue_with_time
    with started(command("ns-viewer"), run, "--websocket-port", 17307) as (_, address):
        tab = browser.open(address)
        shown(tab)
        early = expected(run, tab, look_of(run), 0.0)
        shown_like(tab, early)
        to_the_end(tab)
        late = shown_like(tab, expected(run, tab, look_of(run), 1.0))
        assert decibels(late, early) < 28  # the learnt scene changes with time
        tab.close()


def test_a_run_in_training(browser: Chromium, shared_tiny: Path, tmp_path: Path) -> None:
    words = ["--data", shared_tiny, "--output-dir", tmp_path, "--timestamp", "t", *TINY_NGP]
    words += ["--vis", "viewer", "--viewer.websocket-port", 17207, "--max-num-iterations", 10**6]
    with started(command("ns-train"), "instant-ngp", *words) as (process, address):
        tab = browser.open(address)

        def step() -> int:
            found = re.search(r"step ([\d,]+) · \d+ s", text_of(tab))
            return int(found[1].replace(",", "")) if found else 0

        until(lambda: tab.screenshot()[PICTURE].std() > 5)
        before = until(step)
        until(lambda: step() > before)

        def rests() -> bool:
            now = step()
            tab.pause(2)
            return step() == now

        tab.press("Pause training")
        until(rests)  # the page may be some steps behind
        paused = step()
        tab.pause(2)
        assert step() == paused
        tab.press("Continue training")
        until(lambda: step() > paused)
        tab.close()
        assert process.poll() is None
