"""Every converter and data format: known points are projected to the pixels where the exporter's camera shows them.

Inputs are written as the exporters write them, and the pixels come from their manuals' formulas, in float64, without
any of the framework's mathematics. A converter's data folder is then read as training reads it. Where images are
resampled, a projected point is followed back to the photograph that it was taken from.
"""

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from nerfloom import DataParser, ParsedScene
from nerfloom.base.splits import Split
from nerfloom.dataparsers.nerfstudio import Nerfstudio
from nerfloom.processing import aria, metashape
from nerfloom.processing.aria_lens import NAMES as ARIA_NAMES
from nerfloom.processing.transforms import Lens
from nerfloom.processing.views import positions
from tests.cli.helpers import called
from tests.dataparsers.sparse_models import Capture
from tests.processing import programs, test_aria
from tests.processing.known_poses import without_colmap
from tests.processing.programs import COUNT, HEIGHT, NAMES, WIDTH, in_view, in_world, position_at, rotation_at
from tests.truth import ball, formats

MAX_ERROR = 1e-4
"""Largest distance of a projected point from its pixel, pixels; poses are float32."""
EVERY = Nerfstudio(eval_mode="all")
PLACE = np.array([-2499366.4, -4256836.5, 4029217.9])
"""A place on the Earth, geocentric, metres."""
ON_THE_GLOBE = (programs.ROTATION, PLACE, 12.35)
Y_DOWN = np.diag([1.0, -1, -1])
Seen = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Case:
    """A folder to train on, and what its photographs show."""

    folder: Path
    seen: Callable[[int], Seen]
    """Points (K, 3) in the exporter's frame and their pixels (K, 2), by the number of a photograph."""
    count: int = COUNT
    """Number of photographs."""
    parser: DataParser = EVERY
    lens: Callable[[int], Lens] | None = None
    """Lens of a photograph, if it is resampled."""
    turn: Callable[[int], np.ndarray] = rotation_at
    """(3, 3) camera-to-world of a photograph, y down; needed if it is resampled."""


def converted(kind: str, folder: Path, *flags: object, data: str = "photographs") -> Path:
    """Run ns-process-data; returns the data folder."""
    words = ("--data", folder / data, "--output-dir", folder / "out", "--num-downscales", 0)
    done = called("ns-process-data", kind, *words, *flags)
    assert done.returncode == 0, done.stderr
    return folder / "out"


# -- programs -------------------------------------------------------------------------------------------------------


def seen_by_metashape(calibration: dict[str, float], fisheye: bool, widest: float, similarity: Any, index: int) -> Seen:
    local = in_view(index, widest)
    return programs.to_world(index, local, similarity), programs.metashape_pixels(local, calibration, fisheye)


def from_metashape(
    kind: str, calibration: dict[str, float], folder: Path, similarity: Any = programs.CHUNK, component: bool = False
) -> Case:
    programs.write_images(folder / "photographs")
    more = programs.transform(similarity)
    if component:
        more = f'<components><component id="0" label="Component 1">{more}</component></components>'
    cameras = "".join(programs.camera(i, Path(name).stem, more='component_id="0"') for i, name in enumerate(NAMES))
    xml = folder / "cameras.xml"
    xml.write_text(programs.document(programs.sensor(0, kind, calibration), cameras, more), encoding="utf-8")
    seen = partial(seen_by_metashape, calibration, kind != "frame", 0.35 if kind == "frame" else 0.8, similarity)
    lenses = [camera.lens(WIDTH, HEIGHT) for camera in metashape.read_capture(xml).cameras]
    bent = "b2" in calibration
    return Case(
        converted("metashape", folder, "--xml", xml), seen, lens=(lambda index: lenses[index]) if bent else None,
        turn=lambda index: programs.CHUNK[0] @ rotation_at(index),
    )  # fmt: skip


SIDES = (WIDTH, WIDTH // 2)
"""Width and height of panoramas."""
PANORAMA = Lens(
    "EQUIRECTANGULAR",
    {"w": WIDTH, "h": WIDTH / 2, "fl_x": WIDTH / 2, "fl_y": WIDTH / 2, "cx": WIDTH / 2, "cy": WIDTH / 4},
)


def seen_in_panorama(index: int) -> Seen:
    local = in_view(index, 3.0)
    longitude = np.arctan2(local[:, 0], local[:, 2])
    latitude = np.arctan2(local[:, 1], np.hypot(local[:, 0], local[:, 2]))
    pixels = [(longitude / (2 * np.pi) + 0.5) * WIDTH, (latitude / np.pi + 0.5) * WIDTH / 2]
    return in_world(index, local), np.stack(pixels, 1)


def from_panoramas(treatment: str, folder: Path) -> Case:
    programs.write_images(folder / "photographs", size=SIDES)
    cameras = "".join(programs.camera(i, Path(name).stem) for i, name in enumerate(NAMES))
    sensors = programs.sensor(0, "spherical", None, SIDES)
    (folder / "cameras.xml").write_text(programs.document(sensors, cameras))
    flags = ("--xml", folder / "cameras.xml", "--panoramas", treatment, "--views-up-and-down", "True")
    lens = (lambda _: PANORAMA) if treatment == "views" else None
    return Case(converted("metashape", folder, *flags), seen_in_panorama, lens=lens)


def from_realitycapture(recent: bool, folder: Path) -> Case:
    programs.write_realitycapture(folder, recent)

    def seen(index: int) -> Seen:
        local = in_view(index)
        return programs.realitycapture_world(index, local), programs.realitycapture_pixels(local)

    return Case(converted("realitycapture", folder, "--csv", folder / "cameras.csv"), seen)


def from_odm(kind: str, folder: Path) -> Case:
    size = SIDES if kind == "spherical" else (WIDTH, HEIGHT)
    programs.write_odm(folder / "project", kind, size)
    widest = {"spherical": 3.0, "fisheye": 0.9, "fisheye_opencv": 0.9}.get(kind, 0.3)

    def seen(index: int) -> Seen:
        local = in_view(index, widest)
        return in_world(index, local), programs.opensfm_pixels(local, kind, size)

    return Case(converted("odm", folder, "--panoramas", "whole", data="project"), seen)


def from_bundler(folder: Path) -> Case:
    programs.write_bundler(folder)

    def seen(index: int) -> Seen:
        local = in_view(index)
        return in_world(index, local), programs.bundler_pixels(local)

    return Case(converted("bundler", folder, "--bundle", folder / "bundle.out"), seen)


# -- devices --------------------------------------------------------------------------------------------------------


def from_aria(folder: Path) -> Case:
    test_aria.write_recording(folder)
    lens = aria.lens_for(dict(zip(ARIA_NAMES, test_aria.PARAMS, strict=True)), test_aria.SIDE, test_aria.SIDE)

    def turn(index: int) -> np.ndarray:
        return test_aria.camera_at(test_aria.seconds_of(index))[0]

    def seen(index: int) -> Seen:
        local = in_view(index, 0.6)
        place = test_aria.camera_at(test_aria.seconds_of(index))[1]
        return local @ turn(index).T + place, test_aria.pixels(local) + 0.5  # Aria's first pixel has its centre at 0

    output = converted("aria", folder, "--mps-data-dir", folder / "mps", data="images")
    return Case(output, seen, test_aria.COUNT, lens=lambda _: lens, turn=turn)


def seen_on_ball(lens: ball.Lens, crop: float, index: int) -> Seen:
    points, (fx, fy, cx, cy) = ball.surface(), lens.intrinsics
    pose = ball.opencv_pose(index)
    local = points @ pose[:, :3].T + pose[:, 3]
    x, y = lens.bend(local[:, 0] / local[:, 2], local[:, 1] / local[:, 2])
    return points, np.stack([fx * x + cx - crop, fy * y + cy - crop], 1)


def from_polycam(folder: Path) -> Case:
    formats.write_polycam(folder / "photographs")
    output = converted("polycam", folder, "--crop-border-pixels", 3)
    return Case(output, partial(seen_on_ball, ball.PINHOLE, 3.0), ball.COUNT)


def from_record3d(folder: Path) -> Case:
    formats.write_record3d(folder / "photographs")
    return Case(converted("record3d", folder), partial(seen_on_ball, ball.PINHOLE, 0.0), ball.COUNT)


CONVERTERS: dict[str, Callable[[Path], Case]] = {
    "metashape, frame": partial(from_metashape, "frame", programs.FRAME),
    "metashape, frame with b2, p3, p4": partial(from_metashape, "frame", programs.BENT),
    "metashape, fisheye": partial(from_metashape, "fisheye", programs.FISHEYE),
    "metashape, fisheye of 2.3": partial(from_metashape, "equidistant_fisheye", programs.FISHEYE),
    "metashape, fisheye with b2, p1 to p3": partial(from_metashape, "fisheye", programs.BENT_FISHEYE),
    "metashape, geocentric": partial(from_metashape, "frame", programs.FRAME, similarity=ON_THE_GLOBE, component=True),
    "metashape, panoramas": partial(from_panoramas, "whole"),
    "metashape, views of panoramas": partial(from_panoramas, "views"),
    "realitycapture": partial(from_realitycapture, False),
    "realityscan": partial(from_realitycapture, True),
    **{f"odm, {kind}": partial(from_odm, kind) for kind in programs.OPENSFM},
    "bundler": from_bundler,
    "aria": from_aria,
    "polycam": from_polycam,
    "record3d": from_record3d,
}


@pytest.mark.parametrize("name", CONVERTERS)
def test_points_of_a_converted_capture(name: str, tmp_path: Path) -> None:
    assert worst(CONVERTERS[name](tmp_path)) < MAX_ERROR


# -- COLMAP ---------------------------------------------------------------------------------------------------------

WRITABLE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE")
"""COLMAP's models that ns-process-data fits and transforms.json has a place for."""


@pytest.mark.medium
@pytest.mark.parametrize("model", WRITABLE)
def test_points_of_images_with_what_colmap_finds(model: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    order, lens = formats.COLMAP_CAMERAS[model]
    ball.write_photographs(tmp_path / "photographs", ball.NAMES, lens)
    without_colmap(monkeypatch, formats.camera_line(model, order, lens), formats.model_of())
    output = converted("images", tmp_path, "--camera-model", model)
    assert worst(Case(output, partial(seen_on_ball, lens, 0.0), ball.COUNT)) < MAX_ERROR


@pytest.mark.medium
def test_points_of_equirectangular_images_in_the_views_that_colmap_places(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    programs.write_images(tmp_path / "photographs", size=SIDES)
    names, rotations, translations = [], [], []
    for view in range(4):  # to the right by quarter turns
        x, z = [(1, 0), (0, 1), (-1, 0), (0, -1)][view]
        right, ahead = np.array([x, 0, -z]), np.array([z, 0, x])
        for index, name in enumerate(NAMES):
            names.append(f"view_{view}_{Path(name).stem}.jpg")
            rotations.append(np.stack([right, [0, 1, 0], ahead]) @ rotation_at(index).T)
            translations.append(-rotations[-1] @ position_at(index))
    side = 2 * round(WIDTH / (2 * np.pi))
    lens = f"PINHOLE {side} {side} {side / 2} {side / 2} {side / 2} {side / 2}"
    points = np.concatenate([in_world(index, in_view(index, 0.3, 6)) for index in range(COUNT)])
    without_colmap(monkeypatch, lens, Capture(names, np.stack(rotations), np.stack(translations), points))
    output = converted("images", tmp_path, "--camera-type", "equirectangular", "--num-views", 4)
    assert worst(Case(output, seen_in_panorama, lens=lambda _: PANORAMA)) < MAX_ERROR


# -- data formats ---------------------------------------------------------------------------------------------------

READ: dict[str, ball.Lens] = {
    "nerfstudio": ball.PINHOLE,
    "nerfstudio, bent": formats.BENT,
    "nerfstudio, rational": formats.RATIONAL,
    "nerfstudio, to r^8": formats.LONG,
    "nerfstudio, fisheye": formats.FISHEYE,
    **{f"colmap, {model}": lens for model, (_, lens) in formats.COLMAP_CAMERAS.items()},
    "phototourism": formats.COLMAP_CAMERAS["SIMPLE_RADIAL"][1],
    "llff": formats.MIDDLE,
    "blender": formats.MIDDLE,
    "dtu": ball.PINHOLE,
    "sdfstudio": ball.PINHOLE,
    "polycam": ball.PINHOLE,
    "record3d": ball.PINHOLE,
}
"""Format -> the lens of its photographs."""


@pytest.mark.parametrize("name", READ)
def test_points_of_a_data_format(name: str, tmp_path: Path) -> None:
    form = formats.FORMATS[name]
    count = ball.COUNT - (name == "phototourism")  # it leaves an image out
    case = Case(form.write(tmp_path), partial(seen_on_ball, READ[name], 0.0), count, form.parser)
    assert worst(case) < MAX_ERROR


# -- the measure ----------------------------------------------------------------------------------------------------


def worst(case: Case) -> float:
    """The largest distance of a point's projection from its pixel, pixels."""
    splits: tuple[Split, ...] = ("train",) if case.parser is EVERY else ("train", "val", "test")
    found: dict[int, float] = {}
    points = 0
    for split in splits:
        scene, known = case.parser.parse(case.folder, split), set(found)
        for camera, (index, frame) in enumerate(photographs(case.folder, scene)):
            if index in known:  # val and test may have the same photographs
                continue
            errors = errors_of(case, scene, camera, index, frame)
            points += len(errors)
            found[index] = max(found.get(index, 0.0), float(errors.max(initial=0.0)))
    assert sorted(found) == list(range(case.count))
    assert points > 20 * case.count
    print(f"{points} points of {case.count} photographs miss their pixels by at most {max(found.values()):.1e}")
    return max(found.values())


def photographs(folder: Path, scene: ParsedScene) -> list[tuple[int, dict[str, Any]]]:
    """The number of each image's photograph, and its frame of transforms.json with what all frames share."""
    file = folder / "transforms.json"
    content = json.loads(file.read_text()) if file.exists() else {"frames": []}
    frames = {Path(frame["file_path"]).name: {**content, **frame} for frame in content.pop("frames")}
    found = []
    for path in scene.image_paths:
        frame = frames.get(path.name, {})
        stem = Path(frame.get("source_path", path.name)).stem
        aria_number = re.match(r"214-1-(\d+)-", stem)
        number = int(aria_number[1]) - 1 if aria_number else int(re.findall(r"\d+", stem)[-1])
        found.append((number, frame))
    return found


def errors_of(case: Case, scene: ParsedScene, camera: int, index: int, frame: dict[str, Any]) -> np.ndarray:
    """(K,) distances of the points that an image shows, pixels of the photograph."""
    world, pixels = case.seen(index)
    inside = scene.placement.points(torch.from_numpy(world))
    cameras = scene.cameras.in_float64()
    columns, rows, visible = cameras.project(inside, camera)
    projected = torch.stack([columns, rows], 1).numpy() + 0.5
    if case.lens is None:
        assert bool(visible.all())
        return np.abs(projected - pixels).max(1)
    width, height = int(cameras.widths[camera]), int(cameras.heights[camera])
    shown = visible.numpy() & (projected > 0).all(1) & (projected < [width, height]).all(1)
    placed = scene.placement.transform[:, :3].numpy() @ case.turn(index) @ Y_DOWN
    rotation = placed.T @ cameras.camera_to_worlds[camera, :, :3].numpy()
    values = {name: value for name, value in frame.items() if isinstance(value, int | float)}
    errors = []
    for (column, row), pixel in zip(projected[shown], pixels[shown], strict=True):
        moved = {"w": 1, "h": 1, "cx": values["cx"] - column + 0.5, "cy": values["cy"] - row + 0.5}
        one = Lens(frame["camera_model"].replace("PINHOLE", "OPENCV"), values | moved)
        across, down, _ = positions(case.lens(index), one, rotation, slice(0, 1))
        errors.append(np.hypot(across.item() - pixel[0], down.item() - pixel[1]))
    return np.array(errors)
