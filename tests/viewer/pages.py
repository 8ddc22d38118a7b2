"""Shared by tests of the page: a started viewer, its controls as a person uses them, and its picture."""

import json
import re
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch

from nerfloom.cameras.view import View
from nerfloom.training.trained import load_trained
from nerfloom.viewer.request import Pose, Request
from tests.patience import PATIENCE, until
from tests.viewer.chromium import Tab

PICTURE = np.s_[200:520, 60:540]
"""Rows and columns of the page beside the panel and below the note that WebGL is slow here."""


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


def settled(tab: Tab, seconds: float = 180.0, least: float = 5.0) -> np.ndarray:
    """The page when it has stopped changing, and its grey levels deviate by more than `least`: it is not empty."""
    end, before, rest = time.monotonic() + seconds, tab.screenshot(), 1.5
    while time.monotonic() < end:
        time.sleep(rest)
        start = time.monotonic()
        now = tab.screenshot()
        rest = max(rest, 3 * (time.monotonic() - start))  # a busy machine needs longer for a picture, too
        if np.array_equal(now, before) and now[150:500, 50:500].std() > least:
            return now
        before = now
    raise AssertionError("the page did not come to rest")


def size_of(tab: Tab) -> tuple[int, int]:
    """Width and height of the picture, pixels of the page."""
    width, height = tab.evaluate("(c => [c.clientWidth, c.clientHeight])(document.querySelector('canvas'))")
    return width, height


def text_of(tab: Tab) -> str:
    """The words of the page."""
    return str(tab.evaluate("document.body?.innerText ?? ''"))


def shown(tab: Tab) -> np.ndarray:
    """The picture at rest."""
    return settled(tab)[PICTURE].astype(float)


def shown_like(tab: Tab, picture: np.ndarray, above: float = 30.0) -> np.ndarray:
    """The picture at rest, when it is like another: before, an earlier or a coarse one may rest for a while."""
    return _shown_when(tab, picture, lambda level: level > above)


def shown_unlike(tab: Tab, picture: np.ndarray, below: float = 25.0) -> np.ndarray:
    """The picture at rest, when it is unlike another; below 60 dB, when it is not the same."""
    return _shown_when(tab, picture, lambda level: level < below)


def _shown_when(tab: Tab, picture: np.ndarray, is_so: Callable[[float], bool], seconds: float = 180.0) -> np.ndarray:
    end = time.monotonic() + seconds
    while True:
        found = shown(tab)
        if is_so(level := decibels(found, picture)):
            return found
        assert time.monotonic() < end, f"the picture rests at {level:.2f} dB"


def expected(
    run: Path,
    tab: Tab,
    camera: list[float],
    time: float | None = None,
    fov: float = 50.0,
    longest: int = 1024,
    background: Sequence[float] | None = None,
) -> np.ndarray:
    """The run's model rendered from the page's camera: position, target and up.

    Args:
        longest: longer side of the rendered picture, which is then enlarged to the page's.
        background: colour behind the scene; None for the evaluation background.
    """
    size = size_of(tab)
    width, height = (round(side * min(longest / max(size), 1)) for side in size)
    position, target, up = (torch.tensor(camera[i : i + 3], dtype=torch.float64) for i in (0, 3, 6))
    back = torch.nn.functional.normalize(position - target, dim=0)
    right = torch.nn.functional.normalize(torch.linalg.cross(up, back), dim=0)
    matrix = torch.stack([right, torch.linalg.cross(back, right), back, position], 1)
    model = load_trained(run, device_type="cpu").model
    request = Request(Pose(tuple(matrix.flatten().tolist()), np.radians(fov)), width, height, time=time)
    behind = model.background if background is None else torch.tensor(background)
    picture = model.render_view(View(request.camera(), time=time), behind).rgb.clamp(0, 1).permute(2, 0, 1)[None]
    whole = torch.nn.functional.interpolate(picture, (size[1], size[0]), mode="bilinear")[0].permute(1, 2, 0)
    return whole.numpy()[PICTURE] * 255


def decibels(a: np.ndarray, b: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / (np.square(a - b).mean() + 1e-6)))


def choose(tab: Tab, label: str, option: str) -> None:
    """Choose an option of a list, which is the input beside its label."""
    script = f"""(() => {{
      const found = [...document.querySelectorAll("label")].filter(e => e.textContent.trim() === {json.dumps(label)});
      const row = found[0].parentElement.parentElement;
      const list = document.getElementById(found[0].htmlFor) || row.querySelector("input");
      list.scrollIntoView({{block: "nearest"}});
      const box = list.getBoundingClientRect();
      return [box.x + box.width / 2, box.y + box.height / 2];
    }})()"""
    tab.click(*tab.evaluate(script))
    tab.pause(0.5)
    tab.press(option)


def to_the_end(tab: Tab) -> None:
    """Press End on the first slider, which is the time's if there is one."""
    tab.evaluate("document.querySelector('[role=slider]').focus()")
    tab.key("End", "End", 35)


def type_into(tab: Tab, label: str, index: int, text: str) -> None:
    """Replace the content of one of the fields beside a label, as the keyboard does."""
    script = f"""(() => {{
      const found = [...document.querySelectorAll("label")].filter(e => e.textContent.trim() === {json.dumps(label)});
      const first = document.getElementById(found[0].htmlFor).closest(".mantine-NumberInput-root");
      const field = first.parentElement.querySelectorAll("input")[{index}];
      field.focus();
      field.select();
    }})()"""
    tab.evaluate(script)
    tab.send("Input.insertText", text=text)


def type_text(tab: Tab, label: str, text: str) -> None:
    """Replace the text beside a label, again if the page has just drawn the field anew and kept the old one."""

    def typed() -> bool:
        _type_beside(tab, label, "input", "input", text)
        tab.key("Enter", "Enter", 13)
        tab.pause()
        return bool(tab.evaluate(_field_beside(label, "input", "input") + ".value") == text)

    until(typed)


def type_number(tab: Tab, label: str, text: str) -> None:
    """Replace the number beside a slider."""
    _type_beside(tab, label, "[role=slider]", "input:not([type=hidden])", text)
    tab.pause()


def _field_beside(label: str, part: str, field: str) -> str:
    """Script that finds a field in the row of a label; the row is the label's nearest ancestor with a part."""
    return f"""(() => {{
      let row = [...document.querySelectorAll("label")].filter(e => e.textContent.trim() === {json.dumps(label)})[0];
      while (!row.querySelector({json.dumps(part)})) row = row.parentElement;
      return row.querySelector({json.dumps(field)});
    }})()"""


def _type_beside(tab: Tab, label: str, part: str, field: str, text: str) -> None:
    """Replace the text of a field beside a label (`_field_beside`)."""
    script = f"""(() => {{
      const field = {_field_beside(label, part, field)};
      field.scrollIntoView({{block: "center"}});
      field.focus();
      field.select();
    }})()"""
    tab.evaluate(script)
    tab.send("Input.insertText", text=text)


def tick(tab: Tab, label: str) -> None:
    """Click the box beside a label, when it has come to rest: a folder opens slowly."""
    script = f"""(() => {{
      const found = [...document.querySelectorAll("label")].filter(e => e.textContent.trim() === {json.dumps(label)});
      document.getElementById(found[0].htmlFor).scrollIntoView({{block: "nearest"}});
      const box = document.getElementById(found[0].htmlFor).getBoundingClientRect();
      return [box.x + box.width / 2, box.y + box.height / 2];
    }})()"""
    places = [[], tab.evaluate(script)]
    while places[-2] != places[-1]:
        tab.pause(0.3)
        places.append(tab.evaluate(script))
    box = f"""document.getElementById([...document.querySelectorAll("label")]
      .find(e => e.textContent.trim() === {json.dumps(label)}).htmlFor).checked"""
    before = tab.evaluate(box)
    tab.click(*places[-1])
    until(lambda: tab.evaluate(box) != before)


def pixel_of(tab: Tab, camera: list[float], point: Sequence[float]) -> tuple[np.ndarray, float]:
    """Where the page shows a point, and the pixels of a length of 1 there: a pinhole, in float64."""
    width, height = size_of(tab)
    position, target, up = (np.array(camera[i : i + 3]) for i in (0, 3, 6))
    ahead = (target - position) / np.linalg.norm(target - position)
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    offset, focal = np.array(point) - position, 0.5 * height / np.tan(np.radians(25))
    depth = offset @ ahead
    column, row = offset @ right, -(offset @ np.cross(right, ahead))
    return np.array([width / 2 + focal * column / depth, height / 2 + focal * row / depth]), focal / depth


def meets_box(tab: Tab, camera: list[float], low: Sequence[float], high: Sequence[float]) -> np.ndarray:
    """The rays of the page's picture that meet a box: slabs, in float64, independent of the viewer."""
    width, height = size_of(tab)
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


def look_of(run: Path, index: int = 0) -> list[float]:
    """The camera of a photograph, that of the first one is the page's own: position, target and up."""
    camera = load_trained(run, device_type="cpu").model.scene.camera_to_worlds
    assert camera is not None
    position, back = camera[index, :, 3], camera[index, :, 2]
    return [*position.tolist(), *(position - back).tolist(), 0.0, 0.0, 1.0]
