"""Views of wide images: their directions by hand, and their colours against the colours of these directions."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from nerfloom.base.errors import ConfigError, DataError, FlagError
from nerfloom.processing import colmap
from nerfloom.processing.panoramas import camera_parameters, write_views
from nerfloom.processing.sequence import is_sequence
from nerfloom.processing.settings import ImagesFlags
from nerfloom.processing.transforms import Lens
from nerfloom.processing.unfinished import VIEWS
from nerfloom.processing.views import Views, cut, positions, turned, view_lens
from tests.cli.helpers import called
from tests.processing import programs
from tests.processing.programs import FRAME, NAMES, camera, document, rotation_at, sensor, write_images

WIDE = 512
PANORAMA = Lens(
    "EQUIRECTANGULAR", {"w": WIDE, "h": WIDE // 2, "fl_x": WIDE / 2, "fl_y": WIDE / 2, "cx": WIDE / 2, "cy": WIDE / 4}
)
FISHEYE = Lens(
    "OPENCV_FISHEYE", {"w": 200, "h": 160, "fl_x": 70.0, "fl_y": 70.0, "cx": 100.0, "cy": 80.0, "k1": 0.02, "k2": -0.01}
)


def color_of(directions: np.ndarray) -> np.ndarray:
    """(..., 3) from 0 to 255: a smooth pattern on the sphere; directions are x right, y down, z ahead."""
    waves = np.array([[2.0, 1.0, -1.0], [-1.0, 2.0, 1.5], [1.0, -1.0, 2.0]])
    return 127.5 + 100 * np.sin(directions @ waves.T + [0.3, 1.1, 2.0])


def panorama(turn: np.ndarray) -> np.ndarray:
    """(WIDE / 2, WIDE, 3) uint8: the pattern in a panorama of a camera turned by `turn`."""
    rows, columns = np.mgrid[: WIDE // 2, :WIDE] + 0.5
    longitude, latitude = (columns / WIDE - 0.5) * 2 * np.pi, (rows / (WIDE // 2) - 0.5) * np.pi
    local = [np.cos(latitude) * np.sin(longitude), np.sin(latitude), np.cos(latitude) * np.cos(longitude)]
    return color_of(np.stack(local, -1) @ turn.T).round().astype(np.uint8)


def directions_of(content: dict[str, Any], frame: dict[str, Any]) -> np.ndarray:
    """(H, W, 3) in the world of a view's pixels, by transforms.json; x right, y down of no camera."""
    value = {**content, **frame}
    rows, columns = np.mgrid[: value["h"], : value["w"]] + 0.5
    local = [(columns - value["cx"]) / value["fl_x"], -(rows - value["cy"]) / value["fl_y"], -np.ones_like(rows)]
    found = np.stack(local, -1) @ np.array(frame["transform_matrix"])[:3, :3].T
    return found / np.linalg.norm(found, axis=-1, keepdims=True)


@pytest.mark.parametrize(
    ("right", "up", "ahead"),
    [(0, 0, (0, 0, -1)), (90, 0, (1, 0, 0)), (180, 0, (0, 0, 1)), (0, 90, (0, 1, 0)), (0, -90, (0, -1, 0))],
)
def test_views_look_where_they_should(right: float, up: float, ahead: tuple[float, ...]) -> None:
    rotation = turned(right, up)
    np.testing.assert_allclose(rotation @ [0, 0, -1], ahead, atol=1e-12)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) > 0


@pytest.mark.parametrize(("right", "column"), [(0, 0.5), (90, 0.75), (-90, 0.25), (45, 0.625)])
def test_the_centre_of_a_view_in_a_panorama(right: float, column: float) -> None:
    view = view_lens(PANORAMA, 90.0)
    side = int(view.values["w"])
    columns, rows, inside = positions(PANORAMA, view, turned(right, 0), slice(0, side))
    half = side // 2
    assert columns[half - 1 : half + 1, half - 1 : half + 1].mean() == pytest.approx(column * WIDE)
    assert rows[half - 1 : half + 1].mean() == pytest.approx(WIDE / 4)
    assert inside.all()


def test_a_pixel_of_a_view_is_as_large_as_one_of_the_panorama() -> None:
    view = view_lens(PANORAMA, 90.0)
    assert view.values["fl_x"] == pytest.approx(WIDE / (2 * math.pi), rel=0.01)
    assert view.values["w"] == pytest.approx(2 * view.values["fl_x"])  # 90 degrees
    assert view_lens(FISHEYE, 60.0).values["fl_x"] == pytest.approx(70, rel=0.02)


@pytest.mark.parametrize("views", [Views(6, 90.0, up_and_down=True), Views(3, 110.0)])
def test_colours_of_a_panorama_are_those_of_the_directions(views: Views) -> None:
    found = list(cut(panorama(np.eye(3)), PANORAMA, views))
    assert [view.number for view in found] == list(range(len(views.directions)))
    lens = view_lens(PANORAMA, views.angle).values
    rows, columns = np.mgrid[: int(lens["h"]), : int(lens["w"])] + 0.5
    for view in found:
        ahead = np.stack([(columns - lens["cx"]) / lens["fl_x"], (lens["cy"] - rows) / lens["fl_y"], -1 + 0 * rows], -1)
        local = ahead @ view.rotation.T * [1, -1, -1]
        expected = color_of(local / np.linalg.norm(local, axis=-1, keepdims=True))
        assert np.abs(view.pixels - expected).max() < 2
        assert view.seen.all()


def test_views_beyond_a_fisheye_are_left_out_or_masked() -> None:
    """The image shows 82 degrees to either side, so views that look back see nothing of it."""
    rows, columns = np.mgrid[:160, :200] + 0.5
    image = np.stack([columns, rows, 0 * rows], -1).astype(np.uint8)  # the number of each column, and row
    found = {view.number: view for view in cut(image, FISHEYE, Views(8, 60.0))}
    assert set(found) == {0, 1, 2, 6, 7}
    assert found[0].seen.all()
    assert 0.25 < found[2].seen.mean() < 1
    theta = math.radians(10)  # to the right of the axis, by the model's formula
    expected = 100 + 70 * theta * (1 + 0.02 * theta**2 - 0.01 * theta**4) - 0.5
    lens = view_lens(FISHEYE, 60.0).values
    column = lens["cx"] + lens["fl_x"] * math.tan(theta) - 0.5
    middle = found[0].pixels[int(lens["h"]) // 2, :, 0].astype(float)
    assert np.interp(column, np.arange(len(middle)), middle) == pytest.approx(expected, abs=1.0)


def write_panoramas(folder: Path, count: int = 3) -> list[Path]:
    folder.mkdir(parents=True)
    names = [Path(f"pano_{index + 9}.png") for index in range(count)]
    for index, name in enumerate(names):
        Image.fromarray(panorama(rotation_at(index))).save(folder / name)
    return names


def test_views_for_colmap_are_walks_by_direction(tmp_path: Path) -> None:
    names = write_panoramas(tmp_path / "in")
    work = tmp_path / "work"
    folder, sources = write_views(tmp_path / "in", names, work, Views(4, 90.0))
    assert sources == [Path(f"view_{view}_pano_{index}.png") for view in range(4) for index in (9, 10, 11)]
    assert is_sequence(sources[:3])
    side = view_lens(PANORAMA, 90.0).values["w"]
    for source in sources:
        with Image.open(folder / source) as image:
            assert image.size == (side, side)
    assert sorted(path.name for path in work.iterdir()) == [VIEWS]
    (folder / sources[0]).write_text("as a stopped run left it")
    assert write_views(tmp_path / "in", names, work, Views(4, 90.0)) == (folder, sources)
    assert (folder / sources[0]).read_text() == "as a stopped run left it"


def test_colmap_is_told_the_lens_of_views() -> None:
    values = [float(value) for value in camera_parameters(100, 90.0).split(",")]
    np.testing.assert_allclose(values, [50, 50, 50, 50])


@pytest.mark.parametrize(("kind", "refined"), [("equirectangular", False), ("perspective", True)])
def test_colmap_keeps_a_lens_that_is_known(
    kind: Any, refined: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    found: list[Any] = []

    def incremental_mapping(*_: object, options: Any, **__: object) -> dict[int, Any]:
        found.append(options)
        return {}

    monkeypatch.setattr(pycolmap, "incremental_mapping", incremental_mapping)
    flags = ImagesFlags(data=tmp_path, output_dir=tmp_path / "out", camera_type=kind)
    assert colmap.reconstruct(lambda _: None, tmp_path / "a.db", tmp_path, tmp_path / "sparse", flags) == []
    assert found[0].ba_refine_focal_length is refined
    assert found[0].ba_refine_extra_params is refined
    assert not found[0].ba_refine_principal_point


def test_what_is_no_panorama_is_refused(tmp_path: Path) -> None:
    write_images(tmp_path / "in", ["a.png"])
    with pytest.raises(DataError, match=r"a\.png has 64x48 pixels"):
        write_views(tmp_path / "in", [Path("a.png")], tmp_path / "work", Views(4, 90.0))


def test_flags_that_contradict_each_other(tmp_path: Path) -> None:
    flags: dict[str, Any] = {"data": tmp_path, "output_dir": tmp_path / "out", "camera_type": "equirectangular"}
    with pytest.raises(FlagError, match="--camera-model"):
        ImagesFlags(**flags, camera_model="OPENCV_FISHEYE").check()
    with pytest.raises(ConfigError, match="--masks-dir"):
        ImagesFlags(**flags, masks_dir=tmp_path).check()
    with pytest.raises(FlagError, match="--refine-intrinsics"):
        ImagesFlags(**flags, refine_intrinsics=True).check()
    for name, value in {"num_views": 0, "view_angle": 5.0}.items():
        with pytest.raises(FlagError, match=f"--{name.replace('_', '-')}"):
            ImagesFlags(**flags, **{name: value}).check()


def test_panoramas_beside_photographs_become_views(tmp_path: Path) -> None:
    """A capture of two lenses becomes one data folder; each view shows the world's pattern."""
    panoramas = tmp_path / "photographs"
    names = write_panoramas(panoramas, 2)
    write_images(panoramas, ["DSC_0002.JPG"])
    cameras = "".join(camera(index, name.stem) for index, name in enumerate(names)) + camera(2, "DSC_0002", 1)
    sensors = sensor(0, "spherical", None, (WIDE, WIDE // 2)) + sensor(1, "frame", FRAME)
    (tmp_path / "cameras.xml").write_text(document(sensors, cameras))
    words = ("--data", panoramas, "--output-dir", tmp_path / "out", "--xml", tmp_path / "cameras.xml")
    done = called("ns-process-data", "metashape", *words, "--num-views", 4, "--num-downscales", 1)
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert content["camera_model"] == "OPENCV"
    views = [frame for frame in content["frames"] if "view" in frame["file_path"]]
    assert len(views) == 8
    assert len(content["frames"]) == 9
    assert "images/view_3_pano_9.png" in {frame["file_path"] for frame in views}  # sorted by direction
    for frame in views:
        with Image.open(tmp_path / "out" / frame["file_path"]) as image:
            pixels = np.asarray(image).astype(float)
        assert np.abs(pixels - color_of(directions_of(content, frame))).max() < 2
    assert sorted(path.name for path in (tmp_path / "out" / "images_2").iterdir()) == sorted(
        Path(frame["file_path"]).name for frame in content["frames"]
    )
    done = called("ns-process-data", "metashape", *words, "--overwrite", "--panoramas", "whole")
    assert done.returncode != 0
    assert "--panoramas whole" in " ".join(done.stderr.split())


def test_a_fisheye_beside_a_photograph_has_as_many_views_as_asked_for(tmp_path: Path) -> None:
    """The setting that keeps panoramas whole does not change this, because there are none."""
    write_images(tmp_path / "photographs", NAMES[:2])
    sensors = sensor(0, "fisheye", programs.FISHEYE) + sensor(1, "frame", FRAME)
    cameras = camera(0, Path(NAMES[0]).stem) + camera(1, Path(NAMES[1]).stem, 1)
    (tmp_path / "cameras.xml").write_text(document(sensors, cameras))
    words = ("--data", tmp_path / "photographs", "--output-dir", tmp_path / "out", "--xml", tmp_path / "cameras.xml")
    views = ("--panoramas", "whole", "--num-views", 1, "--view-angle", 60, "--num-downscales", 0)
    done = called("ns-process-data", "metashape", *words, *views)
    assert done.returncode == 0, done.stderr
    frames = json.loads((tmp_path / "out" / "transforms.json").read_text())["frames"]
    assert {frame["file_path"] for frame in frames} == {"images/view_0_DSC_0000.jpg", "images/DSC_0001.jpg"}
