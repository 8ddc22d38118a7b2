"""Headless Chromium, driven through its own protocol over a websocket: pages, the mouse, the keyboard, screenshots."""

import base64
import io
import itertools
import json
import shutil
import signal
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

import imageio.v3 as iio
import numpy as np
import pytest

from tests.patience import PATIENCE, until

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update", "--disable-dev-shm-usage", "--hide-scrollbars"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--force-device-scale-factor=1"),
    *("--remote-debugging-port=0", "--remote-allow-origins=*", "--disable-background-timer-throttling"),
    *("--disable-renderer-backgrounding", "--disable-backgrounding-occluded-windows"),
)
Place = tuple[float, float]
"""Column and row of a page, pixels."""


def between(start: Place, end: Place, steps: int) -> list[Place]:
    """Places on a line, the last one at its end."""
    (x0, y0), (x1, y1) = start, end
    return [(x0 + (x1 - x0) * k / steps, y0 + (y1 - y0) * k / steps) for k in range(1, steps + 1)]


def _twice() -> tuple[float, float]:
    """Two times that have just passed, seconds since the epoch."""
    now = time.time()
    return now - 0.1, now


class Tab:
    """A page in the browser."""

    def __init__(self, address: str, identity: str, port: int) -> None:
        from websockets.sync.client import connect

        self._open = ExitStack()
        self._socket = self._open.enter_context(connect(address, max_size=2**27, open_timeout=PATIENCE))
        self._numbers = itertools.count(1)
        self._identity, self._port = identity, port
        self.send("Page.enable")
        self.send("Runtime.enable")

    def send(self, method: str, **parameters: Any) -> Any:
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._socket.recv(timeout=PATIENCE))
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer.get("result", {})

    def evaluate(self, script: str) -> Any:
        found = self.send("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found["exceptionDetails"]
        return found["result"].get("value")

    def screenshot(self, file: Path | None = None) -> np.ndarray:
        """Picture of the page, (H, W, 3) uint8."""
        content = base64.b64decode(self.send("Page.captureScreenshot", format="png")["data"])
        if file is not None:
            file.write_bytes(content)
        return np.asarray(iio.imread(io.BytesIO(content)))[..., :3]

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def drag(self, start: Place, end: Place, steps: int = 8, button: str = "left", modifiers: int = 0) -> None:
        """Drag with a button of the mouse; the modifier 8 is Shift."""
        held = {"button": button, "modifiers": modifiers}
        buttons = {"left": 1, "right": 2}[button]
        self.mouse("mouseMoved", *start)
        self.mouse("mousePressed", *start, buttons=buttons, clickCount=1, **held)
        for x, y in between(start, end, steps):
            self.mouse("mouseMoved", x, y, buttons=buttons, **held)
            time.sleep(0.03)
        self.mouse("mouseReleased", *end, buttons=0, clickCount=1, **held)

    def click(self, x: float, y: float) -> None:
        self.mouse("mouseMoved", x, y)
        self.mouse("mousePressed", x, y, button="left", buttons=1, clickCount=1)
        self.mouse("mouseReleased", x, y, button="left", buttons=0, clickCount=1)

    def pause(self, seconds: float = 1.0) -> None:
        """Wait for a time by the page's own clock, and for two frames: timers that end before have ended."""
        frames = "requestAnimationFrame(() => requestAnimationFrame(done))"
        self.evaluate(f"new Promise((done) => setTimeout(() => {frames}, {1000 * seconds}))")

    def key(self, key: str, code: str, number: int, held: float = 0.0) -> None:
        """Press a key, and hold it for some seconds of the page's own time."""
        for kind, pause in (("keyDown", held), ("keyUp", 0.0)):
            self.send("Input.dispatchKeyEvent", type=kind, key=key, code=code, windowsVirtualKeyCode=number)
            if pause:
                self.pause(pause)

    def swipe(self, *fingers: tuple[Place, Place], steps: int = 8) -> None:
        """Draw fingers over the page, each from its start to its end."""
        kind = "touchStart"
        for places in zip(*([start, *between(start, end, steps)] for start, end in fingers), strict=True):
            points = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(places)]
            self.send("Input.dispatchTouchEvent", type=kind, touchPoints=points)
            kind = "touchMove"
            time.sleep(0.03)
        self.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def double_click(self, x: float, y: float) -> None:
        """Click twice, a tenth of a second apart by the time of the events, however busy the machine is."""
        for count, at in enumerate(_twice(), 1):
            self.mouse("mousePressed", x, y, button="left", buttons=1, clickCount=count, timestamp=at)
            self.mouse("mouseReleased", x, y, button="left", buttons=0, clickCount=count, timestamp=at)

    def double_tap(self, x: float, y: float) -> None:
        """Touch the page twice with one finger, as `double_click` does."""
        for at in _twice():
            points = [{"x": x, "y": y}]
            self.send("Input.dispatchTouchEvent", type="touchStart", touchPoints=points, timestamp=at)
            self.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[], timestamp=at)

    def resize(self, width: int, height: int, is_phone: bool = False) -> None:
        """Change the size of the page, pixels, and whether it is on a phone, which has fingers and no mouse."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1}
        self.send("Emulation.setDeviceMetricsOverride", **size, mobile=is_phone)
        self.send("Emulation.setTouchEmulationEnabled", enabled=is_phone, maxTouchPoints=2)

    def press(self, text: str) -> None:
        """Click the element with a text."""
        script = f"""(() => {{
          const found = [...document.querySelectorAll("button, label, [role=tab], [role=option], p, span, div")]
            .filter(e => e.textContent.trim() === {json.dumps(text)} && e.offsetParent !== null);
          const last = found[found.length - 1];
          if (!last) return null;
          last.scrollIntoView({{block: "center"}});
          const box = last.getBoundingClientRect();
          return [box.x + box.width / 2, box.y + box.height / 2];
        }})()"""
        place = until(lambda: self.evaluate(script))
        self.click(*place)

    def close(self) -> None:
        self._open.close()
        urllib.request.urlopen(f"http://127.0.0.1:{self._port}/json/close/{self._identity}", timeout=PATIENCE).close()


class Chromium:
    """The browser."""

    def __init__(self, folder: Path, width: int, height: int) -> None:
        program = next(filter(None, map(shutil.which, NAMES)), None)
        if program is None:
            pytest.skip("there is no Chromium; the viewer's page is not opened")
        profile = folder / "profile"
        command = [program, *FLAGS, f"--user-data-dir={profile}", f"--window-size={width},{height}", "about:blank"]
        self._process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        file = profile / "DevToolsActivePort"
        self.port = int(until(lambda: file.is_file() and file.read_text().split("\n")[0]))

    def open(self, address: str) -> Tab:
        request = urllib.request.Request(f"http://127.0.0.1:{self.port}/json/new?{quote(address)}", method="PUT")
        with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
            target = json.load(answer)
        return Tab(target["webSocketDebuggerUrl"], target["id"], self.port)

    def close(self) -> None:
        self._process.send_signal(signal.SIGTERM)
        try:
            self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()


@contextmanager
def chromium(folder: Path, width: int = 900, height: int = 700) -> Iterator[Chromium]:
    """A browser with an empty profile, within a `with` block."""
    browser = Chromium(folder, width, height)
    try:
        yield browser
    finally:
        browser.close()
