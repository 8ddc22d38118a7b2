"""The viewer's other controls in headless Chromium: what each changes in the picture, in a file or in the page."""

import math
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from nerfloom.cameras.camera_path import read_camera_path
from nerfloom.training.trained import load_trained
from tests.cli.helpers import command
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
    pixel_of,
    settled,
    shown,
    shown_like,
    shown_unlike,
    started,
    text_of,
    tick,
    type_into,
    type_number,
    type_text,
)

pytest.importorskip("viser", reason="the extra [viewer] is not installed")
pytestmark = pytest.mark.slow
PHOTOGRAPH_FOV = math.degrees(0.7)
"""Field of view of the tiny data's photographs, degrees."""


def test_resolution_background_cells_and_curve(browser: Chromium, run: Path) -> None:
    look = look_of(run)
    with started(command("ns-viewer"), run, "--websocket-port", 18507) as (_, address):
        tab = browser.open(address)
        first = shown(tab)
        fine = expected(run, tab, look)

        choose(tab, "Resolution", "256")
        coarse = shown_unlike(tab, first, 60)
        small = expected(run, tab, look, longest=256)
        choose(tab, "Resolution", "1024")
        assert decibels(coarse, small) > 30
        assert decibels(coarse, small) > decibels(coarse, fine) + 2
        shown_like(tab, first, 40)

        tab.press("Background")
        tick(tab, "Own colour")
        type_text(tab, "Colour", "rgb(0, 160, 0)")
        shown_like(tab, expected(run, tab, look, background=(0.0, 160 / 255, 0.0)))
        tick(tab, "Own colour")
        shown_like(tab, first, 40)

        tick(tab, "Occupied cells")
        cells = np.abs(shown_unlike(tab, first, 60) - first).max(-1) > 40
        tick(tab, "Occupied cells")
        shown_like(tab, first, 40)
        print(f"cells cover {cells.mean():.2f} of the picture")
        assert cells.mean() > 0.1

        assert "PSNR, dB" not in text_of(tab)
        tab.press("Learning curve")
        until(lambda: tab.evaluate("document.querySelector('.uplot canvas')?.clientHeight > 50"))
        until(lambda: "PSNR, dB" in text_of(tab))
        tab.close()


def test_photographs(browser: Chromium, run: Path) -> None:
    """A click on a camera, and the keys N and P, go to the photographs' cameras."""
    camera, look = 5, look_of(run)  # the opposite camera of ten
    poses = load_trained(run, device_type="cpu").model.scene.camera_to_worlds
    assert poses is not None
    middle = (poses[camera, :, 3] - 0.5 * poses[camera, :, 2]).tolist()
    with started(command("ns-viewer"), run, "--websocket-port", 18607) as (_, address):
        tab = browser.open(address)
        colors = shown(tab)
        choose(tab, "Output", "depth")  # a photograph would not hide in it
        shown_unlike(tab, colors)
        first = settled(tab)[:, 320:560].astype(int)
        tab.press("Photos")
        tick(tab, "Show cameras")
        until(lambda: "10 of 10 cameras" in text_of(tab))

        def covers() -> np.ndarray:
            return np.abs(settled(tab)[:, 320:560] - first).max(-1) > 40

        until(lambda: covers().sum() > 100)
        covered = covers()
        print(f"the other cameras cover {covered.mean():.3f} of the picture")
        assert 100 < covered.sum() < 0.3 * covered.size  # the camera where the page stands would cover all
        place, _ = pixel_of(tab, look, middle)
        tab.mouse("mouseMoved", *place)
        tab.pause()
        tab.click(*place)
        until(lambda: "photograph 5: r_5.png" in text_of(tab))
        tick(tab, "Show cameras")
        tab.press("View")
        choose(tab, "Output", "rgb")
        shown_like(tab, expected(run, tab, look_of(run, camera), fov=PHOTOGRAPH_FOV))
        tab.press("Photos")
        for letter, index in (("n", 6), ("p", 5), ("p", 4)):
            tab.key(letter, f"Key{letter.upper()}", ord(letter.upper()))
            until(lambda index=index: f"photograph {index}: r_{index}.png" in text_of(tab))
        shown_like(tab, expected(run, tab, look_of(run, 4), fov=PHOTOGRAPH_FOV))
        tab.close()


WATCH = """new MutationObserver(() => {
  if (document.body.innerText.includes("Stop")) window.stoppable = true;
}).observe(document.body, { subtree: true, childList: true, characterData: true })"""
"""Notices the button *Stop*, which is there for three seconds."""


def go_to_photograph(tab: Tab, index: int) -> None:
    tab.press("Photos")
    type_into(tab, "Photograph", 0, str(index))
    tab.pause()  # the page sends a number a moment after it was typed
    tab.press("Go to the photograph")
    until(lambda: f"photograph {index}: " in text_of(tab))
    tab.pause()
    tab.press("Path")


def test_path(browser: Chromium, run: Path) -> None:
    """The file has the poses of the photographs where cameras were added, and the numbers that were entered."""
    with started(command("ns-viewer"), run, "--websocket-port", 18707) as (_, address):
        tab = browser.open(address)
        shown(tab)
        tab.press("Path")
        tab.press("Preview")
        until(lambda: "A path needs two cameras." in text_of(tab))
        for count, index in enumerate((0, 3, 6), 1):
            go_to_photograph(tab, index)
            tab.press("Add this camera")
            until(lambda count=count: f"{count} camera" in text_of(tab))
        choose(tab, "Camera", "1")
        tab.press("go to")
        shown_like(tab, expected(run, tab, look_of(run), fov=PHOTOGRAPH_FOV))
        go_to_photograph(tab, 8)
        tab.press("move here")
        choose(tab, "Camera", "2")
        tab.press("remove")
        until(lambda: "2 cameras" in text_of(tab))
        tick(tab, "Closed")
        type_number(tab, "Seconds between", "1.5")
        for label, text in (("Frames per second", "10"), ("Width", "320"), ("Height", "200")):
            type_into(tab, label, 0, text)
        until(lambda: "2 cameras, 3.0 s" in text_of(tab))
        type_text(tab, "Name", "my loop")
        tab.press("Save")
        file = run / "camera_path-myloop.json"
        until(file.is_file)
        before = shown(tab)
        tab.evaluate(WATCH)
        tab.press("Preview")
        until(lambda: tab.evaluate("window.stoppable"))
        until(lambda: "Preview" in text_of(tab))  # it has come to its end
        type_number(tab, "Seconds between", "20")
        tab.press("Preview")
        until(lambda: decibels(tab.screenshot()[PICTURE].astype(float), before) < 25)
        tab.press("Stop")
        until(lambda: "Preview" in text_of(tab))
        tab.close()
    path, poses = read_camera_path(file), load_trained(run, device_type="cpu").model.scene.camera_to_worlds
    file.unlink()
    assert poses is not None
    assert (path.width, path.height, path.seconds, len(path), path.is_cycle) == (320, 200, 3.0, 30, True)
    for keyframe, index in zip(path.keyframes, (8, 6), strict=True):
        torch.testing.assert_close(keyframe.pose.float(), poses[index], atol=1e-4, rtol=0)
        assert keyframe.fov == pytest.approx(PHOTOGRAPH_FOV, abs=1e-3)


def matter(picture: np.ndarray) -> tuple[float, float, float]:
    """Column and row of the middle of the ball, and its area, pixels."""
    rows, columns = (np.abs(picture - 255).max(-1) > 40).nonzero()
    return float(columns.mean()), float(rows.mean()), float(len(rows))


def test_the_mouse_and_the_keys_move_the_camera(browser: Chromium, run: Path) -> None:
    """The ball moves against the camera, and its area grows as the camera comes closer."""
    with started(command("ns-viewer"), run, "--websocket-port", 18807) as (_, address):
        tab = browser.open(address)
        first = shown(tab)
        type_number(tab, "Field of view", "90")
        wide = shown_unlike(tab, first, 60)
        column, row, area = matter(wide)
        tab.drag((300, 300), (350, 330), button="right")
        panned = shown_unlike(tab, wide, 60)
        x, y, _ = matter(panned)
        assert 30 < x - column < 70
        assert 15 < y - row < 45
        tab.drag((350, 330), (300, 300), button="right")
        start = shown_unlike(tab, panned, 60)
        tab.mouse("mouseWheel", 450, 300, deltaX=0, deltaY=-200)
        closer = shown_unlike(tab, start, 60)
        assert matter(closer)[2] > 1.1 * area
        tab.mouse("mouseWheel", 450, 300, deltaX=0, deltaY=200)
        start = shown_unlike(tab, closer, 60)
        for forth, back, axis, sign in (("w", "s", 2, 1), ("a", "d", 0, 1), ("e", "q", 1, 1)):
            before = matter(start)
            for letter, way in ((forth, sign), (back, -sign)):
                tab.key(letter, f"Key{letter.upper()}", ord(letter.upper()), held=0.3)
                end = shown_unlike(tab, start, 60)
                moved, start = matter(end)[axis] - matter(start)[axis], end
                print(f"{letter}: by {moved:.1f}")
                assert way * moved > (0.02 * before[2] if axis == 2 else 2)
        tab.close()


def test_appearance(browser: Chromium, tmp_path: Path) -> None:
    """Every second photograph has a third of the light; the slider chooses whose light is shown."""
    data = write_tiny(tmp_path / "ball", counts=(12, 2, 2))
    for index in range(1, 12, 2):
        file = data / "train" / f"r_{index}.png"
        rgba = iio.imread(file)
        rgba[..., :3] //= 3
        iio.imwrite(file, rgba)
    trainer = tiny_trainer("nerf-w", data, tmp_path / "run", appearance="vector", max_num_iterations=200)
    trainer.train()
    light = []
    with started(command("ns-viewer"), trainer.folder, "--websocket-port", 18907) as (_, address):
        tab = browser.open(address)
        picture = shown(tab)
        for index in (0, 1):
            type_number(tab, "Appearance", str(index))
            picture = shown_unlike(tab, picture, 60)
            light.append(picture[66:146, 350:430].mean())
        tab.close()
    print(f"light of the ball as in the first photograph {light[0]:.0f}, as in the second {light[1]:.0f}")
    assert light[1] < 0.7 * light[0]
