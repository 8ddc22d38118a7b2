"""The viewer's tools in headless Chromium: the box, the lens, the overlay, exports, two runs, keys and fingers."""

from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from scipy.ndimage import binary_dilation, binary_erosion

from nerfloom.geometry.regions import Box, read_regions
from nerfloom.runs import load
from nerfloom.splats.files import read_gaussians
from nerfloom.training.trained import load_trained
from nerfloom.viewer.crop_panel import ARROW
from tests.cli.helpers import command, train
from tests.edit.clouds import ball_in_capture
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
    size_of,
    started,
    text_of,
    tick,
    type_into,
    type_number,
    type_text,
)

pytest.importorskip("viser", reason="the extra [viewer] is not installed")
pytestmark = pytest.mark.slow
WATCH = """(() => {
  window.saved = [];
  const make = URL.createObjectURL;
  URL.createObjectURL = blob => { window.saved.push(blob.size); return make.call(URL, blob); };
})()"""
"""Keeps the sizes of the files that the page saves."""


EDGES = (80, 182, 228)
"""Colour of the box's edges on the page; tone mapping makes it paler."""


def edge_pixels(tab: Tab) -> int:
    """How many pixels of the page at rest have the colour of the box's edges."""
    return int((np.abs(settled(tab)[:, :560].astype(int) - EDGES).max(-1) < 50).sum())


def more_edges(tab: Tab, before: int) -> int:
    """The number of such pixels, if there are clearly more than before; else 0."""
    found = edge_pixels(tab)
    return found if found > before + 100 else 0


def test_the_box_is_drawn_and_an_arrow_is_dragged(browser: Chromium, run: Path) -> None:
    low, high = load_trained(run, device_type="cpu").model.scene.box.double().tolist()
    look, placement = look_of(run), load_trained(run, device_type="cpu").placement
    with started(command("ns-viewer"), run, "--websocket-port", 17607) as (_, address):
        tab = browser.open(address)
        without = edge_pixels(tab)
        tab.press("Crop")
        tick(tab, "Crop")
        type_into(tab, "Highest corner", 2, "0.3")
        tab.pause()
        drawn = until(lambda: more_edges(tab, without))
        top = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, 0.3]
        root, scale = pixel_of(tab, look, top)
        tip, _ = pixel_of(tab, look, [*top[:2], 0.3 + ARROW / scale])
        start, rise = root + 0.6 * (tip - root), 0.7 * ARROW / scale
        tab.drag(tuple(start), tuple(start + 0.7 * (tip - root)))
        tab.pause()
        tab.press("Save the crop")
        file = run / "crop.yaml"
        until(file.is_file)
        tick(tab, "Show the box")
        until(lambda: edge_pixels(tab) < drawn / 2)  # the ball has such colours too
        tab.close()
    (found,) = read_regions(file)
    file.unlink()
    print(f"pixels of edges: {without} without, {drawn} drawn")
    assert isinstance(found, Box)
    ends = placement.points(torch.tensor([found.low, found.high])).tolist()
    np.testing.assert_allclose(ends[0], low, atol=1e-5)
    np.testing.assert_allclose(ends[1][:2], high[:2], atol=1e-5)
    print(f"the face rose by {ends[1][2] - 0.3:.3f} of {rise:.3f}")
    assert ends[1][2] - 0.3 == pytest.approx(rise, rel=0.2)


def test_a_rectangle_and_an_outline_select(browser: Chromium, run: Path) -> None:
    """What the picture shows in them is gone, or all the rest is; in the file, too."""
    look, placement = look_of(run), load_trained(run, device_type="cpu").placement
    rows, columns = np.mgrid[PICTURE]
    in_rectangle = (columns > 180) & (columns < 320) & (rows > 300) & (rows < 440)
    in_outline = (rows > 240) & (np.abs(columns - 300) < 180 * (500 - rows) / 260)
    lines = binary_dilation(in_outline, iterations=4) & ~binary_erosion(in_outline, iterations=4)
    with started(command("ns-viewer"), run, "--websocket-port", 18507) as (_, address):
        tab = browser.open(address)
        whole = shown(tab)
        matter = np.abs(whole - 255).max(-1) > 40  # the background is white

        def shown_without(gone: np.ndarray) -> None:
            """The picture becomes the first one without what is gone, apart from JPEG's blocks at its edge."""
            assert matter[gone].mean() > 0.1
            assert matter[~gone].mean() > 0.1
            clear = ~binary_dilation(gone, iterations=9) | binary_erosion(gone, iterations=9)
            truth = np.where(gone[..., None], 255, whole)
            until(lambda: decibels(shown(tab)[clear], truth[clear]) > 35)

        tab.press("Crop")
        tab.pause()
        tab.press("Draw a rectangle")
        tab.pause()
        tab.drag((180, 300), (320, 440))
        until(lambda: "4 corners" in text_of(tab))
        tab.press("Remove inside")
        shown_without(in_rectangle)
        tab.press("Undo")
        shown_like(tab, whole, 50)
        tab.press("Draw an outline")
        for count, place in enumerate(((120, 240), (480, 240), (300, 500)), 1):
            tab.pause()
            tab.click(*place)
            until(lambda count=count: f"{count} corner" in text_of(tab))
        drawn = shown_unlike(tab, whole, 60)
        tab.press("Keep inside")
        shown_without(~in_outline)
        until(lambda: "1 selection" in text_of(tab))
        kept = shown(tab)
        tab.press("Save the crop")
        file = run / "crop.yaml"
        until(file.is_file)
        points = 2 * torch.rand(300, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 1
        places = np.array([pixel_of(tab, look, point)[0] for point in points.tolist()])
        tab.drag((300, 300), (420, 280))  # the mouse moves the camera again
        shown_unlike(tab, kept, 40)
        tab.close()
    (region,) = read_regions(file)
    file.unlink()
    changed = np.abs(drawn - whole).max(-1) > 40
    print(f"pixels of the outline: {changed.sum()}")
    assert changed.sum() > 300
    assert not (changed & ~lines).any()
    sides = np.abs(places[:, 0] - 300) - 180 * (500 - places[:, 1]) / 260
    found, truth = region.contains(placement.original_points(points)).numpy(), (sides < 0) & (places[:, 1] > 240)
    clear = (np.abs(sides) > 2) & (np.abs(places[:, 1] - 240) > 2)  # clicks are at whole pixels
    assert 30 < truth.sum() < 270
    np.testing.assert_array_equal(found[clear], truth[clear])


def test_field_of_view_and_up(browser: Chromium, run: Path) -> None:
    look = look_of(run)
    with started(command("ns-viewer"), run, "--websocket-port", 17707) as (_, address):
        tab = browser.open(address)
        first = shown(tab)
        type_number(tab, "Field of view", "80")
        shown_like(tab, expected(run, tab, look, fov=80.0))
        type_number(tab, "Field of view", "50")
        choose(tab, "Up", "x")
        tab.pause()
        tilted = shown_like(tab, expected(run, tab, [*look[:6], 1.0, 0.0, 0.0]))
        assert decibels(tilted, first) < 25
        tab.press("Path")
        tab.press("Add this camera")
        tab.press("View")
        choose(tab, "Up", "scene")
        tab.pause()
        shown_like(tab, first, 35)
        for level in (lambda: tab.press("Level"), lambda: tab.key("l", "KeyL", 76)):
            tab.press("Path")
            tab.press("go to")
            shown_like(tab, tilted, 35)
            tab.press("View")
            level()
            shown_like(tab, first, 35)
        tab.close()


def test_a_photograph_lies_over_the_picture(browser: Chromium, run: Path, shared_tiny: Path) -> None:
    rgba = iio.imread(shared_tiny / "train" / "r_0.png").astype(float)
    small = torch.from_numpy(rgba[..., :3] * rgba[..., 3:] / 255 + 255 - rgba[..., 3:]).permute(2, 0, 1)[None]
    with started(command("ns-viewer"), run, "--websocket-port", 17807) as (_, address):
        tab = browser.open(address)
        shown(tab)
        tab.press("Photos")
        tab.press("Go to the photograph")
        tab.pause()
        tab.press("View")
        below = shown(tab)
        type_number(tab, "Overlay", "1")
        over = shown_unlike(tab, below, 60)
        width, height = size_of(tab)
        tab.close()
    large = torch.nn.functional.interpolate(small, (height, height), mode="bilinear")[0].permute(1, 2, 0).numpy()
    left = (width - height) // 2  # the photograph is a square as high as the page
    truth = np.full((height, width, 3), np.nan)
    truth[:, max(left, 0) : left + height] = large[:, max(-left, 0) : width - left]
    truth = truth[PICTURE]
    seen = np.isfinite(truth).all(-1)
    print(
        f"against the photograph: {decibels(below[seen], truth[seen]):.1f} dB, {decibels(over[seen], truth[seen]):.1f}"
    )
    assert seen.mean() > 0.5
    assert decibels(over[seen], truth[seen]) > 33
    assert decibels(over[seen], truth[seen]) > decibels(below[seen], truth[seen]) + 3


def test_what_is_shown_is_exported_and_downloaded(browser: Chromium, shared_tiny: Path, tmp_path: Path) -> None:
    """Of a file with photographs, with the same panels as a run."""
    trainer = tiny_trainer("gaussian-splatting", shared_tiny, tmp_path / "run", max_num_iterations=60)
    trainer.train()
    shown_file = tmp_path / "ball.ply"
    load(trainer.folder, device="cpu").export("gaussian-splat", shown_file)
    words = (shown_file, "--data", shared_tiny, "--websocket-port", 17907)
    with started(command("ns-viewer"), *words) as (_, address):
        tab = browser.open(address)
        shown(tab)
        tab.evaluate(WATCH)
        tab.press("Crop")
        tick(tab, "Crop")
        type_into(tab, "Highest corner", 2, "0")
        tab.pause()
        tab.press("Save the crop")
        until((tmp_path / "crop.yaml").is_file)
        tab.press("Export")
        tab.pause()
        tab.press("Export")  # the button in the tab
        until(lambda: "Wrote splat.ply" in text_of(tab))
        file = tmp_path / "exports" / "ball" / "splat.ply"
        tab.press("Download")
        until(lambda: file.stat().st_size in tab.evaluate("window.saved"))
        choose(tab, "What", "cameras .json")
        tab.press("Export")
        until(lambda: "takes no crop" in text_of(tab))
        tab.close()
    means = read_gaussians(file).gaussians.means.double()
    assert 0 < len(means) < len(read_gaussians(shown_file).gaussians)
    (region,) = read_regions(tmp_path / "crop.yaml")
    assert region.contains(means).all()


def test_floaters_are_counted_and_are_red_points(browser: Chromium, tmp_path: Path) -> None:
    """One of the ball's Gaussians floats, on the axis of a photograph's camera: in the middle of its picture."""
    ball = ball_in_capture(tmp_path)
    assert ball.loaded is not None
    number = [path.name for path in ball.loaded.parsed("train").image_paths].index("004.png")
    words = (tmp_path / "ball.ply", "--data", tmp_path / "capture", "--websocket-port", 18407)
    with started(command("ns-viewer"), *words) as (_, address):
        tab = browser.open(address)
        first = shown(tab)
        tab.press("Photos")
        type_into(tab, "Photograph", 0, str(number))
        tab.pause()
        tab.press("Go to the photograph")
        until(lambda: "004.png" in text_of(tab))
        shown_unlike(tab, first, 60)
        before = settled(tab)

        def changed() -> np.ndarray:
            return np.abs(settled(tab).astype(int) - before)[PICTURE].max(-1) > 40

        tick(tab, "Show floaters")
        until(lambda: "Gaussians float" in text_of(tab))
        until(lambda: changed().sum() > 20)
        text, drawn, after = text_of(tab), changed(), settled(tab)
        width, height = size_of(tab)
        tick(tab, "Show floaters")
        until(lambda: "Gaussians float" not in text_of(tab))
        until(lambda: not changed().any())
        tab.close()
    assert f"1 of {len(ball)} Gaussians float" in text
    rows, columns = drawn.nonzero()
    middle = rows.mean() + PICTURE[0].start + 0.5, columns.mean() + PICTURE[1].start + 0.5
    red, green, blue = after[PICTURE][drawn].mean(0)
    print(f"{len(rows)} pixels around {middle} of {height} x {width}, colour {red:.0f}, {green:.0f}, {blue:.0f}")
    np.testing.assert_allclose(middle, (height / 2, width / 2), atol=3)
    assert red > 150 > 1.5 * max(green, blue)


def test_a_video_has_a_bar_and_is_downloaded(browser: Chromium, run: Path) -> None:
    with started(command("ns-viewer"), run, "--websocket-port", 18007) as (_, address):
        tab = browser.open(address)
        shown(tab)
        tab.evaluate(WATCH)
        tab.press("Path")
        tab.press("Add this camera")
        tab.drag((300, 400), (420, 380))
        tab.pause()
        tab.press("Add this camera")
        tab.pause()
        type_text(tab, "Width", "320")
        type_text(tab, "Height", "180")
        tab.press("Save and render")
        until(lambda: tab.evaluate("document.querySelector('[role=progressbar]') !== null"))
        until(lambda: "Wrote camera" in text_of(tab))
        assert tab.evaluate("document.querySelector('[role=progressbar]') === null")
        (video,) = [file for file in run.glob("camera_path.*") if file.is_file() and file.suffix != ".json"]
        tab.press("Download")
        until(lambda: video.stat().st_size in tab.evaluate("window.saved"))
        tab.close()
    video.unlink()


def test_two_runs_side_by_side(browser: Chromium, run: Path, shared_tiny: Path, tmp_path: Path) -> None:
    second, look = train(shared_tiny, tmp_path, "--max-num-iterations", 20), look_of(run)
    with started(command("ns-viewer"), run, second, "--websocket-port", 18107) as (_, address):
        tab = browser.open(address)
        both, middle = shown(tab), size_of(tab)[0] // 2 - PICTURE[1].start
        ours, theirs = expected(run, tab, look), expected(second, tab, look)
        type_number(tab, "Divider", "1")
        shown_like(tab, ours)
        tab.close()
    left, right = np.s_[:, : middle - 16], np.s_[:, middle + 16 :]  # JPEG's blocks carry errors across the divider
    assert decibels(ours[left], theirs[left]) < 28  # so it matters
    assert decibels(both[left], ours[left]) > 30
    assert decibels(both[right], theirs[right]) > 30


def test_keys(browser: Chromium, run: Path) -> None:
    with started(command("ns-viewer"), run, "--websocket-port", 18207) as (_, address):
        tab = browser.open(address)
        first = shown(tab)
        tab.key("o", "KeyO", 79)
        tab.pause()
        shown_unlike(tab, first, 20)  # depth
        without = edge_pixels(tab)
        tab.key("c", "KeyC", 67)
        tab.pause()
        until(lambda: more_edges(tab, without))
        tab.key("c", "KeyC", 67)
        tab.pause()
        before = shown(tab)
        tab.key("ArrowLeft", "ArrowLeft", 37, held=0.7)
        shown_unlike(tab, before, 30)  # the camera has orbited
        tab.close()


def test_a_narrow_screen_and_a_finger(browser: Chromium, run: Path) -> None:
    with started(command("ns-viewer"), run, "--websocket-port", 18307) as (_, address):
        tab = browser.open("about:blank")
        tab.resize(390, 780, is_phone=True)
        tab.send("Page.navigate", url=address)
        until(lambda: "Field of view" in text_of(tab))
        before = settled(tab)[180:300, 60:330].astype(float)
        assert before.std() > 5
        assert tab.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
        inside = """[...document.querySelectorAll("[role=tab]")].every(tab => {
          const box = tab.getBoundingClientRect();
          return box.left >= 0 && box.right <= window.innerWidth;
        })"""
        assert tab.evaluate(inside)
        tab.swipe(((120, 240), (260, 230)))
        until(lambda: decibels(settled(tab)[180:300, 60:330], before) < 25)  # the finger has turned the camera
        tab.press("nerfloom")
        until(lambda: "Field of view" not in text_of(tab))  # the sheet is folded, and the picture is free
        tab.close()
