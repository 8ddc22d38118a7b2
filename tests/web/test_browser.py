"""The web page in a browser: headless Chromium, from disk, its WebGL in software."""

import math
import re
import subprocess
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from nerfloom.cameras.triangulation import point_covariance, projection_jacobians, reading_error
from nerfloom.cameras.view import View
from nerfloom.evaluation.measuring import Length
from nerfloom.evaluation.metrics import psnr
from nerfloom.evaluation.paths import look_at
from nerfloom.export.octree_page import make_octree_page
from nerfloom.export.web import camera_rows, gaussians_of, make_page
from nerfloom.octrees.drawn import DrawnOctree
from nerfloom.splats.drawing import draw_colors, splat_camera
from nerfloom.splats.gaussians import Gaussians
from nerfloom.splats.look import OURS, Look
from tests.octrees.balls import grains
from tests.patience import PATIENCE, until
from tests.viewer.chromium import Chromium
from tests.web.helpers import ASLANT, SIZE, octree_facts, some_cameras, some_facts, some_gaussians

CLOSE = 45.0
"""Least PSNR of the browser's picture against our renderer's, dB. Rounding to 8 bits alone leaves 59."""
FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update", "--disable-dev-shm-usage", "--hide-scrollbars"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--force-device-scale-factor=1"),
    *("--virtual-time-budget=20000", "--window-size=500,500"),
)


def opened(browser: str, folder: Path, address: str, *flags: str) -> str:
    """Output of Chromium that opens an address, after 20 s of virtual time.

    The page unpacks its data itself: the time of a worker and of the browser's own gunzip is not virtual, so that a
    busy machine might not be done.
    """
    address += f"{'&' if '#' in address else '#'}inflate=here"
    command = [browser, *FLAGS, f"--user-data-dir={folder / 'profile'}", *flags, address]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=True).stdout


def message_in(dom: str) -> str:
    """The message that a page shows. The page's program, which is in the DOM too, has the words of all messages."""
    found = re.search(r'<p id="message"([^>]*)>([^<]*)</p>', dom)
    assert found is not None, dom[:300]
    assert "hidden" not in found[1]
    return found[2]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("page") / "scene.html"
    file.write_text(make_page(some_gaussians(400), some_facts("a </script> title"), 30)[0], encoding="utf-8")
    return file


def pictured(browser: str, scene: Path, tmp_path: Path, camera: int) -> torch.Tensor:
    """The browser's picture from a camera, (H, W, 3)."""
    shot = tmp_path / "shot.png"
    opened(browser, tmp_path, f"{scene.as_uri()}#camera={camera}&plain=1", f"--screenshot={shot}")
    width, height = SIZE
    return torch.from_numpy(iio.imread(shot)[:height, :width, :3].copy()).float() / 255


def compared(seen: torch.Tensor, scene: Path, camera: int, look: Look = OURS) -> float:
    """PSNR of the browser's picture against our own."""
    gaussians = gaussians_of(scene.read_text(encoding="utf-8"))
    chosen = splat_camera(some_cameras()[camera : camera + 1], 0.05, look)
    own = draw_colors(gaussians, chosen, 1, torch.ones(3)).clamp(0, 1)
    assert float(own.std()) > 0.05  # there is something to see
    found = psnr(seen, own)
    print(f"camera {camera}: PSNR of the browser's picture against ours {found:.1f} dB")
    return found


@pytest.mark.medium
def test_the_browser_draws_what_we_draw(browser: str, scene: Path, tmp_path: Path) -> None:
    assert compared(pictured(browser, scene, tmp_path, 3), scene, 3) > CLOSE


@pytest.mark.slow
def test_the_browser_draws_with_its_own_gunzip(live: Chromium, scene: Path) -> None:
    tab = live.open(f"{scene.as_uri()}#camera=1&plain=1")
    until(lambda: tab.evaluate("document.documentElement?.dataset.state") == "ready")
    tab.pause(0.1)
    width, height = SIZE
    seen = torch.from_numpy(tab.screenshot()[:height, :width].copy()).float() / 255
    tab.close()
    assert compared(seen, scene, 1) > CLOSE


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 1, 2])
def test_the_browser_draws_fewer_harmonics(browser: str, tmp_path: Path, degree: int) -> None:
    file = tmp_path / "scene.html"
    look = Look(True, 0.2, "depth")
    facts = some_facts(look=look)
    file.write_text(make_page(some_gaussians(1500, degree), facts, 30)[0], encoding="utf-8")
    assert compared(pictured(browser, file, tmp_path, 2), file, 2, look) > CLOSE


@pytest.fixture(scope="module")
def aslant(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of an octree; its axes are not the page's."""
    file = tmp_path_factory.mktemp("octree") / "scene.html"
    file.write_text(octree_text(1), encoding="utf-8")
    return file


def octree_text(degree: int) -> str:
    """The page of an octree."""
    return make_octree_page(grains(degree), ASLANT, some_cameras(), octree_facts(ASLANT), 30)[0]


def our_octree(degree: int) -> DrawnOctree:
    """The same octree as we draw it; the page's rays start at a distance of 0.05, too."""
    octree = grains(degree)
    return DrawnOctree(octree, replace(octree.scene, near=0.05))


def octrees_compared(browser: str, scene: Path, tmp_path: Path, degree: int, camera: int) -> float:
    """PSNR of the browser's picture against our own."""
    seen = pictured(browser, scene, tmp_path, camera)
    own = our_octree(degree).render_rgb(View(some_cameras()[camera : camera + 1]), torch.ones(3))
    assert float(own.std()) > 0.05  # there is something to see
    found = psnr(seen, own)
    print(f"octree of degree {degree}, camera {camera}: PSNR of the browser's picture against ours {found:.1f} dB")
    return found


@pytest.mark.slow
@pytest.mark.parametrize("camera", [0, 3])
def test_the_browser_traces_what_we_trace(browser: str, aslant: Path, tmp_path: Path, camera: int) -> None:
    assert octrees_compared(browser, aslant, tmp_path, 1, camera) > CLOSE


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 2, 3])
def test_the_browser_traces_other_harmonics(browser: str, tmp_path: Path, degree: int) -> None:
    file = tmp_path / "scene.html"
    file.write_text(octree_text(degree), encoding="utf-8")
    assert octrees_compared(browser, file, tmp_path, degree, 1) > CLOSE


@pytest.mark.slow
def test_the_page_of_an_octree_measures_on_its_surface(browser: str, aslant: Path, tmp_path: Path) -> None:
    """Where half of the light is gone: as far away as we find it."""
    view, pixels = 1, [(97.0, 71.0), (110.0, 80.0)]
    camera = some_cameras()[view : view + 1]
    picture = our_octree(1).render_view(View(camera), torch.ones(3))
    expected = []
    for column, row in pixels:
        rays = camera.rays(torch.zeros(1).long(), torch.tensor([column]), torch.tensor([row]), 0.05, 10.0)
        depth = picture.median_depth[int(row), int(column)]
        assert float(depth) < 5  # the ray meets the octree
        expected.append((rays.origins + depth * rays.directions)[0])
    script = MEASURE.replace("SIZE", "{}, {}".format(*SIZE))
    script = script.replace("PLACES", str([[column + 0.5, row + 0.5] for column, row in pixels]))
    file = tmp_path / "measure.html"
    file.write_text(aslant.read_text(encoding="utf-8").replace("</body>", script + "</body>"), encoding="utf-8")
    dom = opened(browser, tmp_path, f"{file.as_uri()}#camera={view}", "--dump-dom")
    points = re.search(r'data-points="([^"]*)"', dom)
    assert points is not None, dom[:300]
    picked = torch.tensor([[float(x) for x in each.split()] for each in points[1].split("|")])
    torch.testing.assert_close(picked, (torch.stack(expected).double() @ ASLANT.T).float(), atol=1e-3, rtol=0)


DRAG = """<script>
const wait = setInterval(() => {
  const state = document.documentElement.dataset, canvas = document.getElementById("canvas");
  if (state.state !== "ready") return;
  clearInterval(wait);
  const send = (type, x, y, more) => canvas.dispatchEvent(new PointerEvent(
    type, { pointerId: 1, clientX: x, clientY: y, buttons: 1, bubbles: true, cancelable: true, ...more }));
  const seen = [state.eye];
  send("pointerdown", 100, 100); send("pointermove", 160, 90); send("pointerup", 160, 90);
  seen.push(state.eye);
  canvas.dispatchEvent(new WheelEvent("wheel", { deltaY: -300, bubbles: true, cancelable: true }));
  seen.push(state.distance);
  send("pointerdown", 100, 100, { buttons: 2 }); send("pointermove", 160, 90, { buttons: 2 }); send("pointerup", 9, 9);
  seen.push(state.eye);
  window.dispatchEvent(new KeyboardEvent("keydown", { code: "BracketRight" }));
  seen.push(state.camera);
  window.dispatchEvent(new KeyboardEvent("keydown", { code: "KeyR" }));
  seen.push(state.eye);
  state.seen = seen.join("|");
}, 50);
</script>"""


@pytest.mark.medium
def test_the_mouse_turns_and_comes_closer(browser: str, scene: Path, tmp_path: Path) -> None:
    file = tmp_path / "events.html"
    file.write_text(scene.read_text(encoding="utf-8").replace("</body>", DRAG + "</body>"), encoding="utf-8")
    dom = opened(browser, tmp_path, f"{file.as_uri()}#sort=here", "--dump-dom")  # a worker's time is not virtual
    found = re.search(r'data-seen="([^"]*)"', dom)
    assert found is not None, dom[:300]
    first, dragged, distance, panned, camera, reset = found[1].split("|")
    start, eye, moved = (torch.tensor([float(x) for x in text.split()]) for text in (first, dragged, panned))
    focus = torch.tensor(some_facts().focus)
    away = (start - focus).norm()
    torch.testing.assert_close((eye - focus).norm(), away, atol=1e-3, rtol=0)  # about the point looked at
    assert float((eye - start).norm()) > 0.1
    assert float(distance) < 0.9 * float(away)
    assert float((moved - eye).norm()) > 0.1
    assert (camera, reset) == ("1", first)


MOTION = """<script>
const pressed = async (on) => { // browsers may ask for permission first
  while (document.getElementById("motion").getAttribute("aria-pressed") !== on) {
    await new Promise((done) => setTimeout(done, 10));
  }
};
const wait = setInterval(async () => {
  const state = document.documentElement.dataset;
  if (state.state !== "ready") return;
  clearInterval(wait);
  if (typeof DeviceOrientationEvent !== "function") { state.seen = "none"; return; }
  const turn = (alpha, beta) => window.dispatchEvent(
    new DeviceOrientationEvent("deviceorientation", { alpha, beta, gamma: 0 }));
  const seen = [state.eye];
  turn(200, 90); // not yet
  document.getElementById("motion").click();
  await pressed("true");
  turn(10, 90); turn(40, 90);
  seen.push(state.eye);
  document.getElementById("motion").click();
  await pressed("false");
  turn(90, 90);
  seen.push(state.eye);
  state.seen = seen.join("|");
}, 50);
</script>"""


@pytest.mark.medium
def test_a_phone_turns_the_view(browser: str, scene: Path, tmp_path: Path) -> None:
    """It turns by 30 degrees about the vertical through the point looked at, while it is switched on."""
    file = tmp_path / "motion.html"
    file.write_text(scene.read_text(encoding="utf-8").replace("</body>", MOTION + "</body>"), encoding="utf-8")
    dom = opened(browser, tmp_path, f"{file.as_uri()}#sort=here", "--dump-dom")
    found = re.search(r'data-seen="([^"]*)"', dom)
    assert found is not None, dom[:300]
    if found[1] == "none":
        pytest.skip("this Chromium has no orientation events")
    start, turned, after = (torch.tensor([float(x) for x in text.split()]) for text in found[1].split("|"))
    focus, c, s = torch.tensor(some_facts().focus), math.cos(math.pi / 6), math.sin(math.pi / 6)
    about = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    torch.testing.assert_close(turned, focus + about @ (start - focus), atol=5e-3, rtol=0)
    assert torch.equal(after, turned)


@pytest.mark.medium
def test_the_page_starts_from_its_start_view_and_in_the_quality_of_the_address(browser: str, tmp_path: Path) -> None:
    file = tmp_path / "scene.html"
    text, _ = make_page(some_gaussians(100), replace(some_facts(), start=2), 30)
    file.write_text(text, encoding="utf-8")
    dom = opened(browser, tmp_path, f"{file.as_uri()}#sort=here&quality=fast", "--dump-dom")
    assert 'data-camera="2"' in dom
    assert 'data-quality="fast"' in dom
    assert 'data-camera="1"' in opened(browser, tmp_path, f"{file.as_uri()}#sort=here&camera=1", "--dump-dom")


@pytest.mark.medium
def test_damaged_data_are_named(browser: str, scene: Path, tmp_path: Path) -> None:
    text = scene.read_text(encoding="utf-8")
    start = text.index('id="data"') + 2000
    file = tmp_path / "damaged.html"
    file.write_text(text[:start] + "AAAABBBB" + text[start + 8 :], encoding="utf-8")
    dom = opened(browser, tmp_path, file.as_uri(), "--dump-dom")
    assert 'data-state="refused"' in dom
    assert "damaged or truncated" in message_in(dom)


@pytest.mark.slow
def test_no_webgl_is_named(browser: str, scene: Path, tmp_path: Path) -> None:
    dom = opened(browser, tmp_path, scene.as_uri(), "--dump-dom", "--disable-3d-apis")
    assert 'data-state="refused"' in dom
    assert "WebGL 2" in message_in(dom)


MEASURE = """<script>
const wait = setInterval(() => {
  const state = document.documentElement.dataset, canvas = document.getElementById("canvas");
  if (state.state !== "ready") return;
  clearInterval(wait);
  const [w, h] = [SIZE], scale = Math.min(canvas.clientWidth / w, canvas.clientHeight / h);
  const click = ([u, v]) => {
    const x = u * scale + (canvas.clientWidth - w * scale) / 2, y = v * scale + (canvas.clientHeight - h * scale) / 2;
    for (const type of ["pointerdown", "pointerup"]) canvas.dispatchEvent(new PointerEvent(
      type, { pointerId: 1, clientX: x, clientY: y, buttons: 1, bubbles: true, cancelable: true }));
  };
  document.getElementById("measure").click();
  PLACES.forEach(click);
}, 50);
</script>"""


@pytest.mark.medium
def test_the_page_measures_as_we_do(browser: str, tmp_path: Path) -> None:
    """Two points, one before another Gaussian; the length and its error equal Python's."""
    ends = torch.tensor([[0.3, -0.2, 0.1], [-0.2, 0.1, 0.35]])
    places = [[2.5 * math.cos(a), 2.5 * math.sin(a), 0.8] for a in (0.3 * k for k in range(12))]
    poses = torch.stack(
        [look_at(torch.tensor(place), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0])) for place in places]
    )
    cameras, view = replace(some_cameras(12), camera_to_worlds=poses), 2
    eye = cameras.camera_to_worlds[view, :, 3]
    means = torch.cat([ends, eye + 1.2 * (ends[:1] - eye)])  # the last is behind the first
    turns = torch.nn.functional.normalize(torch.tensor([[1.0, 0.3, -0.2, 0.5]]), dim=-1).repeat(3, 1)
    sizes = torch.tensor([[0.03, 0.05, 0.02]]).log().repeat(3, 1)
    opaque = Gaussians(means, sizes, turns, torch.full((3,), 8.0), torch.zeros(3, 3), torch.zeros(3, 3, 0))
    rows = camera_rows(cameras, [str(number) for number in range(12)], torch.eye(3, dtype=torch.float64))
    facts = replace(some_facts(), cameras=rows, unit_length=0.5, unit="m", relative_error=0.01)
    text = make_page(opaque, facts, 30)[0]
    found = gaussians_of(text).means  # rounded by the file
    order = [int((found - end).norm(dim=-1).argmin()) for end in ends]
    first, second = found[order[0]], found[order[1]]
    columns, lines, _ = cameras.project(torch.stack([first, second]), view)
    clicks = (torch.stack([columns, lines], -1) + 0.5).tolist()
    script = MEASURE.replace("SIZE", "{}, {}".format(*SIZE)).replace("PLACES", str(clicks))
    file = tmp_path / "measure.html"
    file.write_text(text.replace("</body>", script + "</body>"), encoding="utf-8")
    shot = tmp_path / "shot.png"
    dom = opened(browser, tmp_path, f"{file.as_uri()}#camera={view}&sort=here", "--dump-dom")
    points = re.search(r'data-points="([^"]*)"', dom)
    assert points is not None, dom[:300]
    picked = torch.tensor([[float(x) for x in each.split()] for each in points[1].split("|")])
    torch.testing.assert_close(picked, torch.stack([first, second]), atol=2e-4, rtol=0)

    square, apart = 0.0, (second - first).double()
    away = torch.nn.functional.normalize(cameras.camera_to_worlds[:, None, :, 3] - torch.stack([first, second]), dim=-1)
    for number, point in enumerate((first, second)):
        columns, lines, ahead = cameras.project(point.expand(len(cameras), 3), torch.arange(len(cameras)))
        inside = (columns > -0.5) & (lines > -0.5) & (columns < SIZE[0] - 0.5) & (lines < SIZE[1] - 0.5)
        seen = ahead & inside & (away[:, number] @ away[view, number] >= 0.5)
        assert int(seen.sum()) >= 2
        jacobians = projection_jacobians(cameras[seen], point)
        along = apart / apart.norm()
        square += float(along @ point_covariance(jacobians, 0.5) @ along) + reading_error(jacobians, 0.5) ** 2
    length = 0.5 * float(apart.norm())
    expected = Length(length, math.hypot(0.5 * square**0.5, 0.01 * length), "m")
    measured = re.search(r'data-measured="([^"]*)"', dom)
    assert measured is not None
    assert measured[1] == str(expected)
    opened(browser, tmp_path, f"{file.as_uri()}#camera={view}&sort=here", f"--screenshot={shot}")
    label = iio.imread(shot)[..., :3].astype(int)
    assert int((np.abs(label - [255, 190, 0]).max(-1) < 30).sum()) > 100  # the line is drawn
