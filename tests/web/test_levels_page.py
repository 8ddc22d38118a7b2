"""The page of levels of detail: its folder of chunks, and the browser that loads them."""

import json
import os
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

import nerfloom
from nerfloom.cameras.poses import Placement
from nerfloom.cameras.view import View
from nerfloom.cli.export import main
from nerfloom.evaluation.metrics import psnr
from nerfloom.export import run_page
from nerfloom.export.levels_page import levels_page
from nerfloom.export.web import BITS, DATA, gaussians_of
from nerfloom.levels.drawn import DrawnLevels
from nerfloom.levels.files import LevelsFile
from nerfloom.levels.settings import DetailSettings
from nerfloom.splats.drawing import draw_colors, splat_camera
from nerfloom.splats.look import OURS
from nerfloom.splats.spz import encoded, read_spz
from nerfloom.splats.transform import transformed
from tests.cli.helpers import called
from tests.conftest import Refused
from tests.levels.made import built, cloud, leaves, scene
from tests.patience import until
from tests.viewer.chromium import Chromium
from tests.web.helpers import SIZE, some_cameras, some_facts
from tests.web.test_browser import message_in, opened

UPRIGHT = torch.eye(3, dtype=torch.float64)


@pytest.fixture
def file(tmp_path: Path) -> LevelsFile:
    return built(tmp_path / "cloud.levels", cloud(3000, 2), 300, memory=2.0)


def facts_in(page: Path) -> dict[str, Any]:
    found = re.search(r'<script id="facts" type="application/json">([^<]*)</script>', page.read_text(encoding="utf-8"))
    assert found is not None
    return json.loads(found[1])


def test_chunks_lie_beside_the_page(file: LevelsFile, tmp_path: Path) -> None:
    """They are in the frame of the page, here the scene's; chunks of earlier pages are removed."""
    out = tmp_path / "out"
    (out / "scene").mkdir(parents=True)
    for old in ("99999.spz", "0123456789abcdef.spz"):
        (out / "scene" / old).write_bytes(b"old")
    (out / "scene" / "mine.spz").write_bytes(b"of somebody else")
    done = called("ns-export", "web", file.path, "--output-dir", out)
    assert done.returncode == 0, done.stderr
    assert "3,000 Gaussians in" in " ".join(done.stderr.split())
    model = nerfloom.load(file.path).model
    assert isinstance(model, DrawnLevels)
    page = out / "scene.html"
    text, facts = page.read_text(encoding="utf-8"), facts_in(page)
    chunks = facts["levels"]["chunks"]
    assert {each.name for each in (out / "scene").iterdir()} == {f"{name}.spz" for name in chunks} | {"mine.spz"}
    assert len(set(chunks)) == len(chunks) == len(file.nodes)
    total = 0
    for index in range(len(file.nodes)):
        expected = transformed(file.read(index), *model.placement.similarity())
        found = read_spz(out / "scene" / f"{chunks[index]}.spz").gaussians
        torch.testing.assert_close(found.means, expected.means, atol=2e-3, rtol=0)
        total += len(found) if index in leaves(file) else 0
    assert total == 3000
    assert "connect-src 'self'" in text
    assert DATA.search(text) is not None
    assert len(gaussians_of(text)) == facts["levels"]["counts"][-1] == int(file.nodes.counts[-1])
    assert facts["levels"]["parents"] == file.nodes.parents.tolist()
    assert (facts["levels"]["folder"], facts["levels"]["total"]) == ("scene", 3000)
    assert 'src="data:image/jpeg;base64,' in text
    assert (out / "scene.jpg").is_file()


def test_an_earlier_page_keeps_its_chunks_until_the_next_one_is_there(
    file: LevelsFile, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An export that ends before it has written its page leaves the earlier one whole."""
    other = built(tmp_path / "other.levels", cloud(900, 2), 300, memory=2.0)
    page, folder = tmp_path / "scene.html", tmp_path / "scene"

    def content() -> dict[str, bytes]:
        return {name: (folder / f"{name}.spz").read_bytes() for name in facts_in(page)["levels"]["chunks"]}

    def stopped(path: Path, write: object) -> None:
        raise KeyboardInterrupt

    nerfloom.load(file.path).export("web", page)
    before = content()
    loaded = nerfloom.load(other.path)
    with monkeypatch.context() as patch:
        patch.setattr(run_page, "write_atomically", stopped)
        with pytest.raises(KeyboardInterrupt):
            loaded.export("web", page)
    assert content() == before
    assert len(list(folder.iterdir())) > len(before)
    loaded.export("web", page)
    assert not content().keys() & before.keys()
    assert {each.stem for each in folder.iterdir()} == content().keys()


def test_what_a_page_of_levels_cannot_be(file: LevelsFile, tmp_path: Path, refused: Refused) -> None:
    out = ("--output-dir", tmp_path / "out")
    assert "ns-export levels" in refused(main, "web", file.path, *out, "--crop-sphere", "0,0,0,1")
    assert "leave it out" in refused(main, "web", file.path, *out, "--kind", "octree")
    assert not (tmp_path / "out" / "scene").exists()


# -- in a browser -------------------------------------------------------------------------------------------------


class Quiet(SimpleHTTPRequestHandler):
    """A static host that prints nothing."""

    def log_message(self, format: str, *args: Any) -> None:
        pass


@contextmanager
def hosted(folder: Path) -> Iterator[str]:
    """The address of a folder on a static host."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def exported(file: LevelsFile, path: Path) -> DrawnLevels:
    """Write a page in the frame of the file; the levels as we draw them."""
    model = DrawnLevels(file, Placement.of(None, 1.0), scene(), torch.device("cpu"), DetailSettings(1.0, 100.0))
    loaded: Any = SimpleNamespace(model=model, origin=file.path)
    path.parent.mkdir(exist_ok=True)
    path.write_text(levels_page(loaded, path, some_facts(), UPRIGHT).text, encoding="utf-8")
    return model


@pytest.fixture
def page(file: LevelsFile, tmp_path: Path) -> tuple[Path, DrawnLevels]:
    """A page, and the levels as we draw them."""
    path = tmp_path / "host" / "scene.html"
    return path, exported(file, path)


def complete(live: Chromium, address: str) -> torch.Tensor:
    """The browser's picture from camera 1, (H, W, 3), when all chunks of its cut are there."""
    tab = live.open(f"{address}#camera=1&plain=1&sort=here")
    until(lambda: tab.evaluate("document.documentElement.dataset.missing") == "0")
    tab.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    width, height = SIZE
    shot = torch.from_numpy(tab.screenshot()[:height, :width].copy()).float() / 255
    tab.close()
    return shot


@pytest.mark.slow
def test_the_browser_loads_and_draws_the_levels_that_we_draw(live: Chromium, page: tuple[Path, DrawnLevels]) -> None:
    """The colours that SPZ rounds are not the coarsest level's."""
    path, model = page
    own = model.render_rgb(View(some_cameras()[1:2]), torch.ones(3)).clamp(0, 1)
    assert float(own.std()) > 0.05  # there is something to see
    assert len(model.cut(View(some_cameras()[1:2])).nodes) > 1
    with hosted(path.parent) as host:
        shot = complete(live, f"{host}/scene.html")
    camera = splat_camera(some_cameras()[1:2], 0.05)
    coarsest = draw_colors(model.file.read(len(model.file.nodes) - 1), camera, 1, torch.ones(3)).clamp(0, 1)
    found, coarse = psnr(shot, own), psnr(coarsest, own)
    print(f"PSNR of the browser's picture of levels against ours {found:.1f} dB, of the coarsest {coarse:.1f}")
    assert found > 35
    assert found > coarse + 5


@pytest.mark.slow
def test_from_disk_the_coarsest_level_is_shown_and_why(
    browser: str, page: tuple[Path, DrawnLevels], tmp_path: Path
) -> None:
    dom = opened(browser, tmp_path, f"{page[0].as_uri()}#sort=here", "--dump-dom")
    assert 'data-state="ready"' in dom
    assert message_in(dom).startswith("Only a coarse version is shown: the rest is in the folder “scene”")


@pytest.mark.slow
def test_chunks_of_another_export_are_not_drawn(
    browser: str, live: Chromium, page: tuple[Path, DrawnLevels], tmp_path: Path
) -> None:
    """The browser keeps chunks of an earlier export, which look fresh for a long time; or the host has wrong ones."""
    path, _ = page
    folder, view = path.with_suffix(""), View(some_cameras()[1:2])
    other = cloud(3000, 2, torch.Generator().manual_seed(1))

    def aged(seconds: int) -> None:
        for chunk in folder.iterdir():
            os.utime(chunk, (seconds, seconds))

    with hosted(path.parent) as host:
        address = f"{host}/scene.html"
        aged(10**9)
        first = complete(live, address)
        model = exported(built(tmp_path / "other.levels", other, 300, memory=2.0), path)
        aged(10**9 + 60)
        shot = complete(live, address)
        fewer = encoded(other[:7], BITS, OURS)
        for chunk in folder.iterdir():
            chunk.write_bytes(fewer)
        dom = opened(browser, tmp_path / "without copies", f"{address}#camera=1&sort=here", "--dump-dom")
    own = model.render_rgb(view, torch.ones(3)).clamp(0, 1)
    print(f"PSNR of the second page {psnr(shot, own):.1f} dB, of the first {psnr(first, own):.1f}")
    assert psnr(shot, own) > 35
    assert psnr(first, own) < 25
    assert 'data-state="ready"' in dom
    assert message_in(dom).startswith("Only a coarse version is shown: The parts of this page do not fit together")
