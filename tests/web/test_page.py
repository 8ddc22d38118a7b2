"""The content of the web page of Gaussians."""

import base64
import fnmatch
import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import torch

from nerfloom.base.errors import ConfigError, DataError
from nerfloom.cli.export import main
from nerfloom.data.pixels.pixel_set import PixelSet
from nerfloom.data.sources import Request, ViewSource
from nerfloom.export import splat_fit
from nerfloom.export.run_page import start_of
from nerfloom.export.splat_fit import PartsOfPhotographs
from nerfloom.export.web import (
    DATA,
    MAX_CAMERAS,
    PICTURE,
    focus_of,
    gaussians_of,
    held_upright,
    make_page,
    page,
    payload_of,
    pinhole,
    shown_cameras,
    turning_arc,
    upright,
    with_still,
)
from nerfloom.kernels.splats.project import rotation_matrices
from nerfloom.splats.look import Look
from nerfloom.splats.spz import read_spz
from nerfloom.testing.scenes import ball_in_a_box
from nerfloom.training.trained import load_trained
from tests.conftest import EditJson, Refused
from tests.training.helpers import tiny_trainer
from tests.web.helpers import some_cameras, some_facts, some_gaussians

ROOT = Path(__file__).parents[2]


class Elements(HTMLParser):
    """Scripts, their text, the text of the title of a page, and its meta elements."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.scripts: list[str] = []
        self.meta: dict[str, str] = {}
        self.title = ""
        self.inside = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.inside = tag
        if tag == "script":
            self.scripts.append("")
        given = dict(attrs)
        if tag == "meta" and (name := given.get("property") or given.get("name")):
            self.meta[name] = given.get("content") or ""

    def handle_endtag(self, tag: str) -> None:
        self.inside = ""

    def handle_data(self, data: str) -> None:
        if self.inside == "script":
            self.scripts[-1] += data
        elif self.inside == "title":
            self.title += data


def test_gaussians_survive_the_page() -> None:
    given = some_gaussians(500)
    given.colors.clamp_(-3, 3)  # the range of SPZ
    given.harmonics.clamp_(-1, 1)
    text, costs = make_page(given, some_facts(), 30)
    assert costs == []
    found = gaussians_of(text)
    # Half a step of SPZ with 8 bits of harmonics (framework/splats/spz.py).
    torch.testing.assert_close(found.means, given.means, atol=1e-3, rtol=0)
    assert float((found.logits.sigmoid() - given.logits.sigmoid()).abs().max()) < 1 / 500
    assert float((found.harmonics - given.harmonics.clamp(-1, 127 / 128)).abs().max()) <= 1 / 256 + 1e-6
    covariances = [
        (m := rotation_matrices(g.rotations.double()) * g.log_scales.double().exp()[:, None]) @ m.mT
        for g in (found, given)
    ]
    sizes = torch.linalg.matrix_norm(covariances[1], 2)
    assert float((torch.linalg.matrix_norm(covariances[0] - covariances[1], 2) / sizes).max()) < 0.1


@pytest.mark.parametrize("megabytes", [0.4, 0.15])
def test_a_page_is_as_small_as_asked(megabytes: float) -> None:
    text, costs = make_page(some_gaussians(5000), some_facts(), megabytes)
    assert 0.5 * megabytes * 1e6 < len(text.encode()) <= megabytes * 1e6
    assert costs[0].startswith(f"{megabytes:g} MB hold ")


@pytest.mark.parametrize("megabytes", [0.0, -1.0, 33.0, math.nan, 0.01])
def test_impossible_sizes_are_refused(megabytes: float) -> None:
    with pytest.raises(ConfigError, match="max-megabytes"):
        make_page(some_gaussians(10), some_facts(), megabytes)


def test_a_page_says_how_its_gaussians_are_drawn(tmp_path: Path) -> None:
    """It says so to its program, and in its SPZ file for other programs."""
    look = Look(True, 0.1, "depth")
    text = make_page(some_gaussians(20), some_facts(look=look), 30)[0]
    found = json.loads(Elements(text).scripts[0])["look"]
    assert found == {"antialiased": True, "blur": 0.1, "sort": "depth"}
    (tmp_path / "page.spz").write_bytes(payload_of(text))
    assert read_spz(tmp_path / "page.spz").look == look


def test_no_name_leaves_its_place() -> None:
    title = "</title></script><script>alert(1)</script>{{data}}&amp;\"'"
    found = Elements(page(b"123", some_facts(title)))
    assert found.title == title
    assert len(found.scripts) == 3
    facts = json.loads(found.scripts[0])
    assert facts["title"] == title
    assert facts["cameras"][3][0] == "</script>"
    assert found.scripts[1] == "MTIz"


def test_link_previews_are_told_title_and_picture() -> None:
    """It uses the names of https://ogp.me, and an address that a program elsewhere can follow."""
    plain = Elements(page(b"", some_facts('A "cup" & <saucer>'))).meta
    assert (plain["og:title"], plain["og:type"]) == ('A "cup" & <saucer>', "website")
    assert plain["og:description"] == "About."
    assert not {"og:image", "og:url"} & plain.keys()
    facts = replace(some_facts(), picture="scene.jpg")
    assert Elements(page(b"", facts)).meta["og:image"] == "scene.jpg"
    for url in ("https://example.org/cup/", "https://example.org/cup/scene.html"):
        found = Elements(page(b"", replace(facts, url=url))).meta
        assert (found["og:url"], found["og:image"]) == (url, "https://example.org/cup/scene.jpg")
        assert (int(found["og:image:width"]), int(found["og:image:height"])) == PICTURE
        assert found["twitter:card"] == "summary_large_image"
    named = replace(facts, picture="my cup #2.jpg", url="https://example.org/")
    found = Elements(page(b"", named)).meta
    assert found["og:image"] == "https://example.org/my%20cup%20%232.jpg"  # a # would end the path (RFC 3986, 3.3)


def test_a_page_starts_from_the_view_that_is_named() -> None:
    names = ["photographs/IMG_1.jpg", "photographs/IMG_2.jpg", "other/IMG_2.png"]
    assert start_of(names, None) == 0
    assert start_of(names, "IMG_1") == start_of(names, "IMG_1.jpg") == 0
    assert start_of(names, "IMG_2.png") == start_of(names, "other/IMG_2.png") == 2
    for wrong, message in (("IMG_2", "2 training images have"), ("IMG_3.jpg", "no training image has")):
        with pytest.raises(ConfigError, match=message):
            start_of(names, wrong)


def test_the_view_that_a_page_starts_from_is_among_those_it_has() -> None:
    assert shown_cameras(5, 3) == [0, 1, 2, 3, 4]
    for start in (0, 1, 700, 999):
        found = shown_cameras(1000, start)
        assert len(found) == MAX_CAMERAS
        assert start in found
        assert found == sorted(set(found))


def test_a_page_asks_no_host_and_runs_no_text() -> None:
    text = page(b"", some_facts())
    for word in ("http:", "https:", "//cdn", "eval(", "new Function", "innerHTML", "SharedArrayBuffer", "import("):
        assert word not in text, word
    assert "default-src 'none'" in text


def test_a_still_picture_fits_into_its_room() -> None:
    """Smaller where there is little, and none where there is hardly any; the scene in the page stays."""
    text, picture = page(b"123", some_facts()), np.zeros((630, 1200, 3), np.uint8)
    picture[:, :400] = (200, 40, 40)
    assert 'alt="test"' in text
    size = len(text.encode())
    assert with_still(text, picture, 1e-6 * size + 1e-5) == text
    widths = list[int]()
    for room in (100_000, 2_500):
        found = with_still(text, picture, 1e-6 * (size + room))
        assert len(found.encode()) <= size + min(room, 60_000)
        assert payload_of(found) == b"123"
        written = re.search(r'<img id="still"[^>]*base64,([^"]*)"', found)
        assert written is not None
        small = iio.imread(base64.b64decode(written[1]))
        assert np.abs(small[5, 5].astype(int) - (200, 40, 40)).max() < 20
        widths.append(small.shape[1])
    assert widths[0] > widths[1]


def test_damaged_pages_are_refused() -> None:
    text = page(b"123", some_facts())
    for damaged in ("", text.replace(">MTIz<", ">M!Iz<")):
        with pytest.raises(DataError):
            gaussians_of(damaged)
    assert payload_of(text) == b"123"
    assert DATA.search(text)


def test_wheels_carry_the_page() -> None:
    section = (ROOT / "pyproject.toml").read_text().partition("[tool.setuptools.package-data]")[2]
    patterns = re.findall(r'"([^"]*)"', section[section.index("\nnerfloom = ") :].splitlines()[1])
    for file in (ROOT / "framework" / "export" / "page").iterdir():
        name = file.relative_to(ROOT / "framework").as_posix()
        assert any(fnmatch.fnmatch(name, pattern) for pattern in patterns), name


# -- cameras ------------------------------------------------------------------------------------------------------


def test_up_is_up() -> None:
    cameras = some_cameras(3)
    assert torch.equal(upright(cameras, False), torch.eye(3).double())
    quarter = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # y is up after it
    turned = replace(cameras, camera_to_worlds=quarter.T @ cameras.camera_to_worlds)
    turn = upright(turned, False)
    up = (turn @ turned.camera_to_worlds[:, :, 1].double().T).mean(1)
    torch.testing.assert_close(up / up.norm(), torch.tensor([0, 0, 1.0]).double())
    torch.testing.assert_close(turn @ turn.T, torch.eye(3).double())
    assert torch.equal(upright(turned, True), torch.eye(3).double())  # they look down, say


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_photographs_from_a_turned_phone_are_shown_upright(quarters: int) -> None:
    """Each pixel has the same ray as in the image turned by `numpy.rot90`."""
    turned = replace(some_cameras(2)[:1], widths=torch.tensor([200]), heights=torch.tensor([150]))
    angle = torch.tensor(quarters * math.pi / 2 + 0.2)
    about = torch.tensor([[angle.cos(), -angle.sin(), 0], [angle.sin(), angle.cos(), 0], [0, 0, 1]])
    poses = torch.cat([turned.camera_to_worlds[:, :, :3] @ about, turned.camera_to_worlds[:, :, 3:]], -1)
    turned = replace(turned, camera_to_worlds=poses)
    found = held_upright(turned)
    pixels = np.stack(np.meshgrid(np.arange(200), np.arange(150)), -1)
    pixels = torch.from_numpy(np.rot90(pixels, quarters).copy())
    assert (int(found.widths), int(found.heights)) == (pixels.shape[1], pixels.shape[0])
    rows, columns = torch.meshgrid(*(torch.arange(side) for side in pixels.shape[:2]), indexing="ij")
    one = torch.zeros(rows.numel(), dtype=torch.int64)
    new = found.rays(one, columns.flatten(), rows.flatten(), 0.0, 1.0)
    old = turned.rays(one, pixels[..., 0].flatten(), pixels[..., 1].flatten(), 0.0, 1.0)
    torch.testing.assert_close(new.directions, old.directions)
    assert float(found.camera_to_worlds[0, 2, 1]) > 0.8


def test_what_looks_straight_down_is_not_turned() -> None:
    down = replace(some_cameras(1), camera_to_worlds=torch.eye(3, 4)[None])
    assert torch.equal(held_upright(down).camera_to_worlds, down.camera_to_worlds)


def test_cameras_look_at_the_focus() -> None:
    found = focus_of(some_cameras(), torch.eye(3).double())
    torch.testing.assert_close(torch.tensor(found), torch.tensor([0.1, 0.0, 0.05]), atol=1e-4, rtol=0)


def test_lenses_become_pinholes() -> None:
    cameras = some_cameras()
    lens = torch.full((4, 4), 0.1)
    assert pinhole(replace(cameras, model="fisheye", lens=lens)).model == "pinhole"
    assert pinhole(replace(cameras, model="equirectangular")).fx.tolist() == [75.0] * 4
    with pytest.raises(ConfigError, match="orthographic"):
        pinhole(replace(cameras, model="orthographic"))


def test_a_page_turns_by_itself_where_photographs_were_taken() -> None:
    """Cameras at 0, 0.5 and 0.9 radians, and turned by 1 with the scene; none if they are all around."""
    cameras = replace(some_cameras(3), camera_to_worlds=torch.stack([about_z(a) for a in (0.0, 0.9, 0.5)]))
    assert turning_arc(cameras, [0.0] * 3, torch.eye(3).double()) == pytest.approx([0.45, 0.9], abs=1e-5)
    turned = turning_arc(cameras, [0.0] * 3, about_z(1.0)[:, :3].double())
    assert turned == pytest.approx([1.45, 0.9], abs=1e-5)
    ring = torch.stack([about_z(k * 2 * math.pi / 7) for k in range(7)])
    assert turning_arc(replace(some_cameras(7), camera_to_worlds=ring), [0.0] * 3, torch.eye(3).double()) is None


def about_z(angle: float) -> torch.Tensor:
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, -s, 0, c], [s, c, 0, s], [0, 0, 1, 0.5]])


def test_parts_of_photographs_show_their_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of a large photograph, also where a mask leaves pixels out."""
    monkeypatch.setattr(splat_fit, "MAX_SIDE", 9)
    dataset = ball_in_a_box()
    kept = torch.rand(len(dataset.pixels), generator=torch.Generator().manual_seed(1)) < 0.7
    dataset = replace(dataset, kept=PixelSet.of_mask(kept))
    parts, photographs = PartsOfPhotographs(dataset, "white", seed=3), ViewSource(dataset, "white", seed=3)
    corners = set()
    for step in range(6):
        part, whole = (source.draw(Request(step, 0)) for source in (parts, photographs))
        given, found = whole.view.camera, part.view.camera
        left, top = round(float(given.cx - found.cx)), round(float(given.cy - found.cy))
        corners.add((left, top))
        here = slice(top, top + 9), slice(left, left + 9)
        assert part.rgb.shape == (9, 9, 3)
        assert torch.equal(found.camera_to_worlds, given.camera_to_worlds)
        assert torch.equal(part.rgb, whole.rgb[here])
        assert part.weights is not None
        assert whole.weights is not None
        assert torch.equal(part.weights, whole.weights[here])
    assert len(corners) > 1


# -- the command --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def splats(shared_tiny: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The config of a run of Gaussians on the ball."""
    folder = tmp_path_factory.mktemp("run") / "run"
    trainer = tiny_trainer("gaussian-splatting", shared_tiny, folder, max_num_iterations=20)
    trainer.train()
    return trainer.folder / "config.yml"


def export(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> None:
    monkeypatch.setattr("sys.argv", ["ns-export", "web", *map(str, arguments)])
    main()


@pytest.mark.medium
def test_splats_go_to_the_page_as_they_are(
    splats: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    export(monkeypatch, splats, "--output-dir", tmp_path)
    found = gaussians_of((tmp_path / "scene.html").read_text(encoding="utf-8"))
    trained = load_trained(splats).model.gaussians()
    torch.testing.assert_close(found.means, trained.means, atol=1e-3, rtol=0)
    said = capsys.readouterr().err
    assert f"{len(trained):,} Gaussians" in said
    assert "held-out views: PSNR" in said
    close = float(said.split("PSNR ")[1].split(" dB")[0])
    print(f"PSNR of the page against the method's own pictures: {close} dB")
    assert close > 40
    assert sorted(file.name for file in tmp_path.iterdir()) == ["scene.html", "scene.jpg"]
    picture = iio.imread(tmp_path / "scene.jpg")
    assert picture.shape == (PICTURE[1], PICTURE[0], 3)
    assert picture.std() > 5  # the ball is on it


@pytest.mark.medium
def test_what_the_page_cannot_be(splats: Path, tmp_path: Path, refused: Refused) -> None:
    assert "phones" in refused(main, "web", splats, "--output-dir", tmp_path, "--max-megabytes", 50, status=2)
    assert "no times" in refused(main, "web", splats, "--output-dir", tmp_path, "--time", 0.5)
    assert "no training image" in refused(main, "web", splats, "--output-dir", tmp_path, "--start-view", "x.jpg")
    assert "must begin with https" in refused(main, "web", splats, "--output-dir", tmp_path, "--url", "cup", status=2)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.usefixtures("even_clock")  # the fit has seconds, and a busy machine learns less in them
def test_a_field_gets_gaussians_that_look_like_it(
    shared_tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    trainer = tiny_trainer("instant-ngp", shared_tiny, tmp_path / "run", max_num_iterations=200)
    trainer.train()
    capsys.readouterr()
    export(monkeypatch, trainer.folder / "config.yml", "--output-dir", tmp_path / "out", "--fit-seconds", 12)
    close = float(capsys.readouterr().err.split("PSNR ")[1].split(" dB")[0])
    print(f"PSNR of the page against the field's pictures: {close} dB")
    assert close > 20  # a white picture has 8


@pytest.fixture
def moving_run(tiny: Path, edit_json: EditJson, tmp_path: Path) -> Path:
    """The config of a K-Planes run."""
    edit_json(lambda content: [frame.update(time=i / 9) for i, frame in enumerate(content["frames"])])
    trainer = tiny_trainer("kplanes", tiny, tmp_path / "run", max_num_iterations=150)
    trainer.train()
    return trainer.folder / "config.yml"


@pytest.mark.slow
def test_a_scene_that_moves_is_shown_at_one_moment(
    moving_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    export(monkeypatch, moving_run, "--output-dir", tmp_path / "out", "--fit-seconds", 4, "--time", 0.25)
    said = capsys.readouterr().err
    assert "0 photographs" in said
    assert "time 0.25, still" in said
    assert "dropped" not in said
    assert "against the photographs" not in said
    text = (tmp_path / "out" / "scene.html").read_text(encoding="utf-8")
    assert "this is time 0.25" in json.loads(Elements(text).scripts[0])["about"]
