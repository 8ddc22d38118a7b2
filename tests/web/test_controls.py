"""Each control of the web page in headless Chromium, from disk: a real mouse, real keys and real fingers on it."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfloom.cameras.cameras import Cameras
from nerfloom.evaluation.paths import look_at
from nerfloom.export.octree_page import make_octree_page
from nerfloom.export.web import camera_rows, gaussians_of, make_page
from nerfloom.splats.gaussians import Gaussians
from tests.octrees.balls import ball
from tests.patience import until
from tests.viewer.chromium import Chromium, Place, Tab
from tests.web.helpers import octree_facts, some_facts

pytestmark = pytest.mark.slow
UPRIGHT = torch.eye(3, dtype=torch.float64)
RED, BLUE = (255, 0, 0), (0, 0, 255)
FROM = 2.0
"""Distance of the cameras from the origin."""
DESK, PHONE = (800, 600), (390, 844)
"""Sizes of windows, pixels."""


def four_cameras() -> Cameras:
    """Cameras on a circle around the origin, level, which look at it; the first is on the x axis."""
    angles = [0.5 * math.pi * k for k in range(4)]
    eyes = [torch.tensor([FROM * math.cos(a), FROM * math.sin(a), 0.0]) for a in angles]
    poses = torch.stack([look_at(eye, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0])) for eye in eyes])
    one = torch.ones(4)
    return Cameras(poses, 200 * one, 200 * one, 100 * one, 75 * one, (200 * one).long(), (150 * one).long())


def two_balls(arc: list[float] | None = None) -> str:
    """The page of a red Gaussian in the origin, which the cameras look at, and a blue one beside it."""
    colors = torch.tensor([RED, BLUE]) / 255 * 3.54 - 1.77
    means = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.4, 0.15]])
    turns = torch.tensor([[1.0, 0.0, 0.0, 0.0]] * 2)
    balls = Gaussians(means, torch.full((2, 3), 0.06).log(), turns, torch.full((2,), 8.0), colors, torch.zeros(2, 3, 0))
    facts = replace(some_facts("Two balls"), cameras=rows(), focus=[0.0] * 3, arc=arc, unit="m")
    return make_page(balls, facts, 30)[0]


def rows() -> list[list[object]]:
    return camera_rows(four_cameras(), ["a.png", "b.png", "c.png", "d.png"], UPRIGHT)


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Addresses on disk of a page of Gaussians and of one of an octree."""
    facts = replace(octree_facts(UPRIGHT), cameras=rows(), focus=[0.0] * 3)
    texts = {"gaussians": two_balls(), "octree": make_octree_page(ball(), UPRIGHT, four_cameras(), facts, 30)[0]}
    folder = tmp_path_factory.mktemp("pages")
    for name, text in texts.items():
        (folder / f"{name}.html").write_text(text, encoding="utf-8")
    return {name: (folder / f"{name}.html").as_uri() for name in texts}


def opened(live: Chromium, address: str, size: tuple[int, int] = DESK, is_phone: bool = False) -> Tab:
    """The page in a window of a size, when it is drawn."""
    tab = live.open("about:blank")
    tab.resize(*size, is_phone)
    tab.send("Page.navigate", url=f"{address}#sort=here")
    until(lambda: state(tab, "state") == "ready")
    return tab


def state(tab: Tab, name: str) -> str:
    return str(tab.evaluate(f"document.documentElement?.dataset.{name}"))


def numbers(tab: Tab, name: str) -> np.ndarray:
    return np.array([float(word) for word in state(tab, name).split()])


def box(tab: Tab, name: str) -> list[float]:
    """Left, top, right and bottom of an element; no numbers while it is not shown."""
    script = f"""(() => {{
      const found = document.getElementById("{name}"), box = found.getBoundingClientRect();
      return found.checkVisibility() ? [box.left, box.top, box.right, box.bottom] : [];
    }})()"""
    return list(tab.evaluate(script))


def press(tab: Tab, name: str) -> None:
    """Click the middle of an element."""
    left, top, right, bottom = box(tab, name)
    tab.click((left + right) / 2, (top + bottom) / 2)


def picture(tab: Tab) -> np.ndarray:
    """The page at rest."""
    before = None
    while True:
        tab.evaluate("new Promise((done) => setTimeout(() => requestAnimationFrame(done), 300))")
        now = tab.screenshot().astype(int)
        if before is not None and np.array_equal(now[90:], before[90:]):  # below the count of frames a second
            return now
        before = now


def blob(tab: Tab, color: Sequence[int]) -> tuple[np.ndarray, float]:
    """Column and row of the middle of a ball on the page, and its radius, pixels."""
    inside = np.abs(picture(tab) - color).max(-1) < 100
    lines, columns = inside.nonzero()
    assert len(lines) > 20, "it is not on the page"
    return np.array([columns.mean() + 0.5, lines.mean() + 0.5]), math.sqrt(len(lines) / math.pi)


def test_it_turns_to_and_fro_where_photographs_were_taken(live: Chromium, tmp_path: Path) -> None:
    """Over an arc of 0.5 radians around the direction of the first camera, past neither end."""
    (tmp_path / "a.html").write_text(two_balls([0.0, 0.5]), encoding="utf-8")
    tab = opened(live, (tmp_path / "a.html").as_uri())
    seen: list[float] = []

    def passed(angle: float) -> bool:
        x, y, _ = numbers(tab, "eye")
        seen.append(math.atan2(y, x))
        return (seen[-1] > angle) if angle > 0 else (seen[-1] < angle)

    press(tab, "spin")
    for angle in (-0.2, 0.2, -0.2):
        until(lambda angle=angle: passed(angle))
    assert max(map(abs, seen)) < 0.26
    tab.close()


MIDDLE: Place = (DESK[0] / 2, DESK[1] / 2)
SCENE = slice(90, 440)
"""Rows of the page on a desk that have no words."""
FOCAL = 4 * 200.0
"""Focal length on the page, pixels."""


@pytest.mark.parametrize("kind", ["gaussians", "octree"])
def test_each_button(live: Chromium, pages: dict[str, str], kind: str) -> None:
    tab = opened(live, pages[kind])
    eyes = four_cameras().camera_to_worlds[:, :, 3].numpy()
    first = numbers(tab, "eye")
    np.testing.assert_allclose(first, eyes[0], atol=1e-4)
    assert_apart(tab, *DESK)
    loaded = "performance.getEntriesByType('resource').filter((e) => !/^(data|blob):/.test(e.name)).length"
    assert tab.evaluate(loaded) == 0  # the file is all that it needs
    assert tab.evaluate("document.title") == tab.evaluate("document.querySelector('h1').textContent") != ""

    shots = [picture(tab)]
    for name, camera in (("next", 1), ("next", 2), ("previous", 1)):
        press(tab, name)
        until(lambda camera=camera: state(tab, "camera") == str(camera))
        np.testing.assert_allclose(numbers(tab, "eye"), eyes[camera], atol=1e-4)
        assert tab.evaluate("document.getElementById('name').textContent") == f"{camera + 1} of 4: {'abcd'[camera]}.png"
    left, top, right, bottom = box(tab, "slider")
    tab.click(right - 3, (top + bottom) / 2)
    until(lambda: state(tab, "camera") == "3")
    shots.append(picture(tab))
    press(tab, "reset")
    until(lambda: state(tab, "camera") == "0")
    shots.append(picture(tab))
    if kind == "gaussians":  # the ball of leaves looks the same from all sides
        assert np.abs(shots[1] - shots[0])[SCENE].max() > 100
    np.testing.assert_array_equal(shots[2][SCENE], shots[0][SCENE])

    for color in (0, 128, 255):  # from white to black, grey and white again
        press(tab, "behind")
        np.testing.assert_allclose(picture(tab)[300, 5], color, atol=1)

    press(tab, "spin")
    until(lambda: np.abs(numbers(tab, "eye") - first).max() > 0.3)
    assert tab.evaluate("document.getElementById('spin').ariaPressed") == "true"
    press(tab, "spin")
    eye = numbers(tab, "eye")
    assert np.linalg.norm(eye) == pytest.approx(FROM, abs=1e-3)
    assert eye[2] == pytest.approx(0, abs=1e-3)
    picture(tab)
    np.testing.assert_array_equal(numbers(tab, "eye"), eye)

    press(tab, "ask")
    left, top, right, bottom = until(lambda: box(tab, "help"))
    assert left >= 0
    assert top >= 0
    assert right <= DESK[0]
    assert bottom <= DESK[1]
    widths = []
    for quality in ("full", "fast", "automatic"):
        press(tab, "quality")
        until(lambda quality=quality: state(tab, "quality") == quality)
        picture(tab)
        widths.append(tab.evaluate("document.getElementById('canvas').width"))
    assert widths == [DESK[0], DESK[0] / 2, DESK[0]]
    press(tab, "close")
    until(lambda: not box(tab, "help"))

    press(tab, "full")
    until(lambda: tab.evaluate("document.fullscreenElement !== null"))
    press(tab, "full")
    until(lambda: tab.evaluate("document.fullscreenElement === null"))
    assert not box(tab, "motion")  # a computer has no such sensor
    tab.close()


def test_each_drag_of_the_mouse(live: Chromium, pages: dict[str, str]) -> None:
    """The red ball is where the cameras look, so its place and size follow from each movement."""
    tab = opened(live, pages["gaussians"])
    red, radius = blob(tab, RED)
    blue, _ = blob(tab, BLUE)
    np.testing.assert_allclose(red, MIDDLE, atol=1)

    tab.drag((300, 200), (380, 230))
    place, size = blob(tab, RED)
    np.testing.assert_allclose(place, MIDDLE, atol=1)  # it turns about the point looked at
    assert size == pytest.approx(radius, rel=0.02)
    assert np.linalg.norm(blob(tab, BLUE)[0] - blue) > 10
    assert np.linalg.norm(numbers(tab, "eye")) == pytest.approx(FROM, abs=1e-3)

    press(tab, "reset")
    tab.drag((300, 200), (360, 240), button="right")
    np.testing.assert_allclose(blob(tab, RED)[0], np.add(MIDDLE, (60, 40)), atol=1.5)

    press(tab, "reset")
    tab.mouse("mouseWheel", *MIDDLE, deltaX=0, deltaY=-300)
    place, size = blob(tab, RED)
    np.testing.assert_allclose(place, MIDDLE, atol=1)
    assert size / radius == pytest.approx(math.exp(0.36), rel=0.03)

    press(tab, "reset")
    eye = numbers(tab, "eye")
    tab.drag((300, 200), (340, 200), modifiers=8)
    np.testing.assert_array_equal(numbers(tab, "eye"), eye)
    angle = 3.5 / DESK[1] * 40
    np.testing.assert_allclose(blob(tab, RED)[0], (MIDDLE[0] - FOCAL * math.tan(angle), MIDDLE[1]), atol=2)

    press(tab, "reset")
    blue, _ = blob(tab, BLUE)
    tab.double_click(*blue)
    np.testing.assert_allclose(blob(tab, BLUE)[0], MIDDLE, atol=2)

    press(tab, "reset")
    red, blue = blob(tab, RED)[0], blob(tab, BLUE)[0]
    press(tab, "measure")
    tab.click(*red)
    tab.click(*blue)
    text = until(lambda: tab.evaluate("document.querySelector('#ruler text').textContent"))
    means = gaussians_of(two_balls()).means
    assert float(text.split(" m")[0]) == pytest.approx(float((means[1] - means[0]).norm()), abs=0.005)
    ruler = np.abs(picture(tab) - (255, 190, 0)).max(-1) < 60
    lines, columns = ruler.nonzero()
    ends = [(columns.min() + columns.max() + 1) / 2, (lines.min() + lines.max() + 1) / 2]
    np.testing.assert_allclose(ends, (red + blue) / 2, atol=3)
    press(tab, "measure")
    assert (np.abs(picture(tab) - (255, 190, 0)).max(-1) < 60).sum() == 0
    tab.close()


FLIGHTS = {
    "KeyW": (-1, 0, 0), "ArrowUp": (-1, 0, 0), "KeyS": (1, 0, 0), "ArrowDown": (1, 0, 0), "KeyA": (0, -1, 0),
    "ArrowLeft": (0, -1, 0), "KeyD": (0, 1, 0), "ArrowRight": (0, 1, 0), "KeyQ": (0, 0, -1), "KeyE": (0, 0, 1),
}  # fmt: skip
"""Directions of flight of the first camera, which is on the x axis, level, and looks at the origin."""


def test_each_key(live: Chromium, pages: dict[str, str]) -> None:
    tab = opened(live, pages["gaussians"])
    first, white = numbers(tab, "eye"), picture(tab)

    def key(code: str, held: float = 0.0) -> None:
        tab.key(code.removeprefix("Key").lower(), code, 0, held)

    for code, way in FLIGHTS.items():
        key(code, 0.2)
        until(lambda: numbers(tab, "eye").tolist() != first.tolist())
        step = numbers(tab, "eye") - first
        np.testing.assert_allclose(step / np.linalg.norm(step), way, atol=1e-3, err_msg=code)
        key("KeyR")
        until(lambda: numbers(tab, "eye").tolist() == first.tolist())

    for code, camera in (("BracketRight", 1), ("BracketLeft", 0), ("BracketLeft", 3), ("KeyR", 0)):
        key(code)
        until(lambda camera=camera: state(tab, "camera") == str(camera))
    key("KeyB")
    assert picture(tab)[300, 5].tolist() == [0, 0, 0]
    key("KeyB")
    key("KeyB")
    key("KeyH")
    until(lambda: not box(tab, "bar") and not box(tab, "head"))
    key("KeyH")
    until(lambda: box(tab, "bar"))
    np.testing.assert_array_equal(picture(tab)[SCENE], white[SCENE])
    tab.key("?", "Slash", 191)
    until(lambda: box(tab, "help"))
    tab.key("Escape", "Escape", 27)
    until(lambda: not box(tab, "help"))
    key("KeyM")
    until(lambda: tab.evaluate("document.getElementById('measure').ariaPressed") == "true")
    key("KeyM")
    key("KeyT")
    until(lambda: np.abs(numbers(tab, "eye") - first).max() > 0.1)
    key("KeyT")
    key("KeyF")
    until(lambda: tab.evaluate("document.fullscreenElement !== null"))
    tab.close()


CONTROLS = ("previous", "slider", "next", "reset", "spin", "measure", "motion", "behind", "full", "ask")


def assert_apart(tab: Tab, width: int, height: int) -> None:
    """All controls are on the screen, and none covers another or has cut words."""
    boxes = {name: found for name in CONTROLS if (found := box(tab, name))}
    for name, (left, top, right, bottom) in boxes.items():
        assert left >= 0, name
        assert top >= 0, name
        assert right <= width, name
        assert bottom <= height, name
        assert name == "slider" or min(right - left, bottom - top) >= 34, name
        for other, (start, above, end, below) in boxes.items():
            apart = right <= start or end <= left or bottom <= above or below <= top
            assert name == other or apart, (name, other)
    cut = "[...document.querySelectorAll('#bar button')].filter((e) => e.scrollWidth > e.clientWidth + 1).length"
    assert tab.evaluate(cut) == 0
    assert box(tab, "head")[3] <= box(tab, "bar")[1]


def test_a_phone_and_its_fingers(live: Chromium, pages: dict[str, str]) -> None:
    tab = opened(live, pages["gaussians"], PHONE, is_phone=True)
    assert_apart(tab, *PHONE)
    middle = np.array(PHONE) / 2
    red, radius = blob(tab, RED)
    np.testing.assert_allclose(red, middle, atol=1)

    tab.swipe(((100, 200), (180, 220)))
    np.testing.assert_allclose(blob(tab, RED)[0], middle, atol=1)
    eye = numbers(tab, "eye")
    assert abs(eye[1]) > 0.1
    assert np.linalg.norm(eye) == pytest.approx(FROM, abs=1e-3)

    press(tab, "reset")
    tab.swipe(((150, 300), (110, 300)), ((250, 300), (290, 300)))  # from 100 pixels apart to 180
    place, size = blob(tab, RED)
    np.testing.assert_allclose(place, middle, atol=2)
    assert size / radius == pytest.approx(1.8, rel=0.04)

    press(tab, "reset")
    tab.swipe(((150, 300), (180, 350)), ((250, 300), (280, 350)))
    np.testing.assert_allclose(blob(tab, RED)[0], np.add(middle, (30, 50)), atol=2)

    press(tab, "reset")
    blue, _ = blob(tab, BLUE)
    tab.double_tap(*blue)
    np.testing.assert_allclose(blob(tab, BLUE)[0], middle, atol=2)

    press(tab, "ask")
    left, top, right, bottom = until(lambda: box(tab, "help"))
    assert (left >= 0, top >= 0, right <= PHONE[0], bottom <= PHONE[1]) == (True,) * 4
    press(tab, "close")

    press(tab, "motion")
    until(lambda: tab.evaluate("document.getElementById('motion').ariaPressed") == "true")
    tab.resize(*PHONE[::-1], is_phone=True)
    tab.pause(0.5)
    assert_apart(tab, *PHONE[::-1])
    tab.close()
