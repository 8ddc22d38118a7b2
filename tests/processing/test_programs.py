"""Captures that other programs placed: what is read, refused and left out. Projections: `test_reprojection.py`."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from nerfloom.base.errors import DataError
from nerfloom.data.ply import read_points
from nerfloom.dataparsers.nerfstudio import Nerfstudio
from nerfloom.processing import bundler, metashape, opensfm, point_files, realitycapture
from nerfloom.processing.geocentric import EQUATOR, POLE, east_north_up
from tests.cli.helpers import called
from tests.processing.programs import (
    CHUNK,
    COUNT,
    FRAME,
    HEIGHT,
    NAMES,
    ROTATION,
    WIDTH,
    camera,
    document,
    in_view,
    position_at,
    realitycapture_world,
    sensor,
    to_world,
    transform,
    write_bundler,
    write_images,
    write_metashape,
    write_odm,
    write_realitycapture,
)

PLACE = np.array([-2499366.4, -4256836.5, 4029217.9])
"""A place on the Earth, geocentric, metres."""


def process(kind: str, data: Path, output: Path, *flags: object) -> tuple[dict[str, Any], str]:
    """Run ns-process-data; returns transforms.json and the output."""
    done = called("ns-process-data", kind, "--data", data, "--output-dir", output, "--num-downscales", 0, *flags)
    assert done.returncode == 0, done.stderr
    return json.loads((output / "transforms.json").read_text()), " ".join(done.stderr.split())


def frames_of(content: dict[str, Any]) -> list[dict[str, Any]]:
    """Frames in the order of `NAMES`; some may be missing."""
    return sorted(content["frames"], key=lambda frame: str(frame["source_path"]))


# -- Metashape ------------------------------------------------------------------------------------------------------


def write_cameras(folder: Path, sensors: str, cameras: str, more: str = "") -> Path:
    """cameras.xml beside photographs."""
    write_images(folder / "photographs")
    file = folder / "cameras.xml"
    file.write_text(document(sensors, cameras, more), encoding="utf-8")
    return file


def all_cameras(more: str = "") -> str:
    return "".join(camera(index, Path(name).stem, more=more) for index, name in enumerate(NAMES))


def test_panoramas_of_metashape_may_stay_whole(tmp_path: Path) -> None:
    write_images(tmp_path / "photographs", size=(WIDTH, WIDTH // 2))
    (tmp_path / "cameras.xml").write_text(document(sensor(0, "spherical", None, (WIDTH, WIDTH // 2)), all_cameras()))
    flags = ("--xml", tmp_path / "cameras.xml", "--panoramas", "whole")
    content, said = process("metashape", tmp_path / "photographs", tmp_path / "out", *flags)
    assert "ns-train gaussian-splatting --data" in said
    assert content["camera_model"] == "EQUIRECTANGULAR"
    scene = Nerfstudio(eval_interval=0).parse(tmp_path / "out", "train")
    assert scene.cameras.model == "equirectangular"


def test_a_component_leads_to_the_globe_and_up_is_away_from_it(tmp_path: Path) -> None:
    """Metashape 2 writes the component's transform, and geocentric coordinates."""
    similarity = (ROTATION, PLACE, 12.35)
    component = f'<components><component id="0" label="Component 1">{transform(similarity)}</component></components>'
    reference = '<reference>GEOGCS["WGS 84",DATUM["World Geodetic System 1984"]]</reference>'
    cameras = all_cameras('component_id="0"')
    xml = write_cameras(tmp_path, sensor(0, "frame", FRAME), cameras, component + reference)
    content, _ = process("metashape", tmp_path / "photographs", tmp_path / "out", "--xml", xml)

    assert content["orientation_override"] == "none"
    applied = np.array(content["applied_transform"])
    higher = PLACE * (1 + 1 / np.linalg.norm(PLACE))  # a metre farther from the centre of the Earth
    np.testing.assert_allclose(applied[:, :3] @ (higher - PLACE), [0, 0, 1], atol=5e-3)
    assert np.abs([frame["transform_matrix"][0][3] for frame in content["frames"]]).max() < 100
    scene = Nerfstudio(eval_interval=0).parse(tmp_path / "out", "train")
    assert scene.transform is not None
    np.testing.assert_allclose(scene.transform[:, :3].numpy(), applied[:, :3], atol=1e-12)


def test_a_component_is_on_the_globe_whatever_another_one_lacks(tmp_path: Path) -> None:
    """The other component has no transform: too few of its photographs state where they were taken."""
    component = f'<components><component id="0">{transform((ROTATION, PLACE, 12.35))}</component></components>'
    cameras = "".join(
        camera(index, Path(name).stem, more=f'component_id="{int(index == 0)}"') for index, name in enumerate(NAMES)
    )
    capture = metashape.read_capture(write_cameras(tmp_path, sensor(0, "frame", FRAME), cameras, component))
    assert capture.z_is_up
    assert [item.name for item in capture.cameras] == [Path(name).stem for name in NAMES[1:]]
    assert capture.left_out[metashape.OTHER] == 1
    placed = [capture.frame[:, :3] @ item.pose[:3, 3] + capture.frame[:, 3] for item in capture.cameras]
    assert np.abs(placed).max() < 100


def test_cameras_that_are_left_out_are_counted_with_reasons(tmp_path: Path) -> None:
    sensors = sensor(0, "frame", FRAME) + sensor(1, "cylindrical", FRAME) + sensor(2, "frame", None)
    cameras = camera(0, "DSC_0000") + f'<group id="0" label="walk">{camera(1, "DSC_0001")}</group>'
    cameras += camera(2, "DSC_0002", placed=False) + camera(3, "DSC_0003", more='enabled="false"')
    cameras += camera(4, "DSC_0004", sensor_id=1) + camera(5, "elsewhere") + camera(6, "x", sensor_id=2)
    cameras += camera(7, "z", placed=False, more='master_id="0"')
    xml = write_cameras(tmp_path, sensors, cameras)
    content, said = process("metashape", tmp_path / "photographs", tmp_path / "out", "--xml", xml)
    assert [frame["source_path"] for frame in frames_of(content)] == NAMES[:2]
    assert "2 of 8 cameras are placed" in said
    for reason in (
        "1 not aligned", "1 disabled", "1 of 'cylindrical' sensors", "1 without image",
        "1 of sensors without calibration", "1 in a rig without transforms",
    ):  # fmt: skip
        assert reason in said, reason


def test_a_sensor_of_photographs_that_were_never_aligned_needs_no_size(tmp_path: Path) -> None:
    sensors = sensor(0, "frame", FRAME) + '<sensor id="1" label="unknown" type="frame"/>'
    cameras = all_cameras() + camera(COUNT, "DSC_0099", 1, placed=False)
    capture = metashape.read_capture(write_cameras(tmp_path, sensors, cameras))
    assert len(capture.cameras) == COUNT
    assert dict(capture.left_out) == {"not aligned": 1, metashape.OTHER: 0}


def test_of_components_that_are_not_connected_the_largest_is_taken(tmp_path: Path) -> None:
    cameras = "".join(
        camera(index, Path(name).stem, more=f'component_id="{int(index == 0)}"') for index, name in enumerate(NAMES)
    )
    capture = metashape.read_capture(write_cameras(tmp_path, sensor(0, "frame", FRAME), cameras))
    assert [item.name for item in capture.cameras] == [Path(name).stem for name in NAMES[1:]]
    assert capture.left_out[metashape.OTHER] == 1


@pytest.mark.parametrize(
    "labels",
    [
        [f"D:\\survey\\nadir\\{name}" for name in NAMES],
        [f"/home/user/nadir/{name.lower()}" for name in NAMES],
        [f"../../{name}" for name in NAMES],
        [f"lost/{NAMES[0]}", *(f"{index}/{Path(name).stem}" for index, name in enumerate(NAMES[1:]))],
    ],
)
def test_names_from_another_machine(labels: list[str], tmp_path: Path) -> None:
    xml = write_cameras(tmp_path, sensor(0, "frame", FRAME), "".join(map(camera, range(COUNT), labels)))
    content, _ = process("metashape", tmp_path / "photographs", tmp_path / "out", "--xml", xml)
    assert [frame["source_path"] for frame in frames_of(content)] == NAMES
    matrix = np.array(frames_of(content)[2]["transform_matrix"])
    np.testing.assert_allclose(matrix[:3, 3], position_at(2), atol=1e-12)


def test_two_folders_with_the_same_names_are_told_apart_by_groups(tmp_path: Path) -> None:
    write_images(tmp_path / "photographs", [f"{side}/{name}" for side in ("left", "right") for name in NAMES[:2]])
    groups = ""
    for number, side in enumerate(("left", "right")):
        both = camera(2 * number, "DSC_0000") + camera(2 * number + 1, "DSC_0001")
        groups += f'<group id="{number}" label="{side}">{both}</group>'
    (tmp_path / "cameras.xml").write_text(document(sensor(0, "frame", FRAME), groups))
    content, _ = process("metashape", tmp_path / "photographs", tmp_path / "out", "--xml", tmp_path / "cameras.xml")
    found = {frame["source_path"]: frame["transform_matrix"][0][3] for frame in content["frames"]}
    expected = {
        f"{side}/{NAMES[i]}": position_at(2 * n + i)[0] for n, side in enumerate(("left", "right")) for i in (0, 1)
    }
    assert found == pytest.approx(expected)


def test_images_of_another_size_and_of_another_shape(tmp_path: Path) -> None:
    xml = write_cameras(tmp_path, sensor(0, "frame", FRAME), all_cameras())
    for name, size in zip(NAMES, [(WIDTH, HEIGHT), (2 * WIDTH, 2 * HEIGHT), (HEIGHT, WIDTH)], strict=False):
        Image.new("RGB", size).save(tmp_path / "photographs" / name)
    content, said = process("metashape", tmp_path / "photographs", tmp_path / "out", "--xml", xml)
    first, second = frames_of(content)[:2]
    assert (first["w"], second["w"], second["h"]) == (WIDTH, 2 * WIDTH, 2 * HEIGHT)
    assert [second[key] for key in ("fl_x", "cx", "cy")] == [2 * first[key] for key in ("fl_x", "cx", "cy")]
    assert second["k1"] == first["k1"]
    assert "1 with an image of another shape" in said
    assert not (tmp_path / "out/images/DSC_0002.jpg").exists()


XML = {
    "no xml": "cameras",
    "cut off": document(sensor(0, "frame", FRAME), all_cameras())[:-200],
    "a doctype": '<!DOCTYPE d [<!ENTITY a "aa"><!ENTITY b "&a;&a;">]>' + document(sensor(0, "frame", FRAME), "&b;"),
    "no chunk": "<document/>",
    "nan": document(sensor(0, "frame", FRAME), all_cameras().replace("0.0 0.0 0.0 1.0", "0.0 0.0 nan 1.0")),
    "too few numbers": document(sensor(0, "frame", FRAME), all_cameras().replace("0.0 0.0 0.0 1.0", "0.0")),
    "a mirror": document(sensor(0, "frame", FRAME), all_cameras(), transform((-ROTATION, np.zeros(3), 1.0))),
    "no scale": document(sensor(0, "frame", FRAME), all_cameras(), transform((ROTATION, np.zeros(3), 0.0))),
    "a huge number": document(sensor(0, "frame", {**FRAME, "k1": 1e300}), all_cameras()),
    "no focal length": document(sensor(0, "frame", {"cx": 0.0}), all_cameras()),
    "a negative focal length": document(sensor(0, "frame", {**FRAME, "f": -3.0}), all_cameras()),
    "no size": document(sensor(0, "frame", FRAME).replace("width=", "breadth="), all_cameras()),
    "an unknown encoding": '<?xml version="1.0" encoding="latin-99"?><document/>',
}


@pytest.mark.parametrize("name", XML)
def test_broken_xml_is_refused_in_a_line(name: str, tmp_path: Path) -> None:
    (tmp_path / "cameras.xml").write_text(XML[name], encoding="utf-8")
    with pytest.raises(DataError, match=r"cameras\.xml") as error:
        metashape.read_capture(tmp_path / "cameras.xml")
    assert "\n" not in str(error.value)


def test_nothing_is_written_if_no_image_is_there(tmp_path: Path) -> None:
    write_metashape(tmp_path)
    write_images(tmp_path / "others", ["a.png"])
    words = ("--output-dir", tmp_path / "out", "--xml", tmp_path / "cameras.xml")
    done = called("ns-process-data", "metashape", "--data", tmp_path / "others", *words)
    assert done.returncode != 0
    assert "the image of none of 5 cameras" in " ".join(done.stderr.split())
    assert not (tmp_path / "out").exists()


# -- points ---------------------------------------------------------------------------------------------------------


def write_ply(file: Path, points: np.ndarray) -> Path:
    names = [*(f"property float {axis}" for axis in "xyz"), *(f"property uchar {c}" for c in ("red", "green", "blue"))]
    head = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *names, "end_header"]
    rows = [f"{x!r} {y!r} {z!r} 10 20 30" for x, y, z in points.tolist()]
    file.write_text("\n".join([*head, *rows]) + "\n")
    return file


def test_points_go_with_the_cameras(tmp_path: Path) -> None:
    write_metashape(tmp_path)
    points = np.concatenate([to_world(index, in_view(index)) for index in range(COUNT)])
    flags = ("--xml", tmp_path / "cameras.xml", "--ply", write_ply(tmp_path / "points.ply", points))
    content, _ = process("metashape", tmp_path / "photographs", tmp_path / "out", *flags)
    found = read_points(tmp_path / "out" / content["ply_file_path"]).numpy()
    np.testing.assert_allclose(found, points, atol=1e-6)
    assert "10 20 30" in (tmp_path / "out" / "sparse_pc.ply").read_text()


def test_points_of_another_coordinate_system_are_refused(tmp_path: Path) -> None:
    write_metashape(tmp_path)
    ply = write_ply(tmp_path / "points.ply", to_world(0, in_view(0)) + np.array([500_000, 5_000_000, 0]))
    words = ("--output-dir", tmp_path / "out", "--xml", tmp_path / "cameras.xml", "--ply", ply)
    done = called("ns-process-data", "metashape", "--data", tmp_path / "photographs", *words)
    assert done.returncode != 0
    assert "another coordinate system" in " ".join(done.stderr.split())


def test_of_a_dense_cloud_some_points_are_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(point_files, "MAX_POINTS", 4)
    capture = metashape.read_capture(write_cameras(tmp_path, sensor(0, "frame", FRAME), all_cameras()))
    points = in_view(0, count=10)
    found = point_files.with_points(capture, write_ply(tmp_path / "points.ply", points)).points
    assert found is not None
    np.testing.assert_allclose(found, points[[0, 3, 6, 9]])
    with pytest.raises(DataError, match=r"none\.ply has no point"):
        point_files.with_points(capture, write_ply(tmp_path / "none.ply", points[:0]))


@pytest.mark.parametrize(("kind", "factor"), [("uchar", 1), ("ushort", 257), ("float", 1 / 255)])
def test_colours_of_any_type(kind: str, factor: float, tmp_path: Path) -> None:
    capture = metashape.read_capture(write_cameras(tmp_path, sensor(0, "frame", FRAME), all_cameras()))
    points, file = in_view(0, count=3), tmp_path / "points.ply"
    stored = " ".join(repr(value * factor) for value in (10, 0, 255))
    text = write_ply(file, points).read_text().replace("property uchar", f"property {kind}").replace("10 20 30", stored)
    file.write_text(text)
    found = point_files.with_points(capture, file).colors
    assert found is not None
    assert found.tolist() == [[10, 0, 255]] * 3


@pytest.mark.parametrize(("kind", "rounded"), [("f4", True), ("f8", False)])
def test_points_that_single_precision_has_rounded(
    kind: str, rounded: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Geocentric coordinates have seven digits before the point, so float32 keeps half metres."""
    component = f'<components><component id="0">{transform((ROTATION, PLACE, 1.0))}</component></components>'
    xml = write_cameras(tmp_path, sensor(0, "frame", FRAME), all_cameras('component_id="0"'), component)
    points = np.concatenate([to_world(index, in_view(index), (ROTATION, PLACE, 1.0)) for index in range(COUNT)])
    name = {"f4": "float", "f8": "double"}[kind]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    head += [*(f"property {name} {axis}" for axis in "xyz"), "end_header\n"]
    (tmp_path / "points.ply").write_bytes("\n".join(head).encode() + points.astype(f"<{kind}").tobytes())
    point_files.with_points(metashape.read_capture(xml), tmp_path / "points.ply")
    said = " ".join(capsys.readouterr().err.split())
    assert ("rounded its coordinates by up to 0.25" in said) is rounded


def test_coordinates_of_a_map_lose_nothing(tmp_path: Path) -> None:
    """Half a million metres east and five north: points keep fractions of a millimetre."""
    far = np.array([500_000.25, 5_000_000.5, 120.0])
    write_realitycapture(tmp_path)
    file = tmp_path / "cameras.csv"
    head, *rows = file.read_text().splitlines()
    moved = []
    for row in rows:
        name, x, y, z, *rest = row.split(",")
        moved.append(",".join([name, *(repr(float(a) + float(b)) for a, b in zip((x, y, z), far, strict=True)), *rest]))
    file.write_text("\n".join([head, *moved]))
    points = realitycapture_world(0, in_view(0)) + far
    flags = ("--csv", file, "--ply", write_ply(tmp_path / "points.ply", points))
    content, _ = process("realitycapture", tmp_path / "photographs", tmp_path / "out", *flags)
    applied = np.array(content["applied_transform"])
    found = read_points(tmp_path / "out" / "sparse_pc.ply").numpy() - applied[:, 3]
    assert np.abs(found - points).max() < 1e-5
    assert np.abs([frame["transform_matrix"][1][3] for frame in content["frames"]]).max() < 10


# -- RealityCapture -------------------------------------------------------------------------------------------------


def test_realitycapture_states_what_is_up(tmp_path: Path) -> None:
    write_realitycapture(tmp_path)
    _, said = process("realitycapture", tmp_path / "photographs", tmp_path / "out", "--csv", tmp_path / "cameras.csv")
    assert "5 of 5 cameras are placed" in said
    unplaced = Nerfstudio(eval_interval=0, center_method="none", auto_scale_poses=False)
    scene = unplaced.parse(tmp_path / "out", "train")
    assert scene.transform is not None
    np.testing.assert_allclose(scene.transform[:, :3].numpy(), np.eye(3), atol=1e-12)


def test_degrees_are_no_lengths(tmp_path: Path) -> None:
    """A flight above a field of 100 m, in WGS 84; the same numbers of metres around 0 are a mast."""
    draws = np.random.default_rng(5)
    places = np.stack([*draws.uniform(-5e-4, 5e-4, (2, COUNT)), draws.uniform(86, 90, COUNT)], 1)
    for far, refused in ((np.array([-34.8288, 7.1633, 0]), True), (np.zeros(3), False)):
        write_realitycapture(tmp_path)
        head, *rows = (tmp_path / "cameras.csv").read_text().splitlines()
        rows = [
            ",".join([row.split(",")[0], *map(repr, (place + far).tolist()), *row.split(",")[4:]])
            for row, place in zip(rows, places, strict=True)
        ]
        (tmp_path / "cameras.csv").write_text("\n".join([head, *rows]))
        if refused:
            with pytest.raises(DataError, match="degrees of longitude and latitude"):
                realitycapture.read_capture(tmp_path / "cameras.csv")
        else:
            assert len(realitycapture.read_capture(tmp_path / "cameras.csv").cameras) == COUNT


def test_photographs_that_were_not_aligned_are_counted(tmp_path: Path) -> None:
    """The file has only the cameras that are placed."""
    write_realitycapture(tmp_path)
    file = tmp_path / "cameras.csv"
    file.write_text("\n".join(file.read_text().splitlines()[:3]))
    write_images(tmp_path / "photographs", ["sketches/plan.png"])
    _, said = process("realitycapture", tmp_path / "photographs", tmp_path / "out", "--csv", file)
    assert "2 of 2 cameras are placed" in said
    assert f"3 other images have no placed camera, the first: {NAMES[2]}" in said


def test_heading_pitch_and_roll_have_their_meaning() -> None:
    assert np.allclose(realitycapture.rotation_of(0, 0, 0) @ [0, 0, -1], [0, 0, -1])  # down
    level = realitycapture.rotation_of(90, 90, 0)
    np.testing.assert_allclose(level @ [0, 0, -1], [1, 0, 0], atol=1e-12)  # east
    np.testing.assert_allclose(level @ [0, 1, 0], [0, 0, 1], atol=1e-12)  # upright


CSV: dict[str, Callable[[list[str]], list[str]]] = {
    "no header": lambda lines: lines[1:],
    "no focal length": lambda lines: ["#name,x,y,alt,heading,pitch,roll", *lines[1:]],
    "a word": lambda lines: [lines[0], lines[1].replace("170.3", "north"), *lines[2:]],
    "nan": lambda lines: [lines[0], lines[1].replace("170.3", "nan"), *lines[2:]],
    "endless": lambda lines: [lines[0], lines[1].replace("170.3", "1e400"), *lines[2:]],
    "decimal commas": lambda lines: [lines[0], *(line.replace(".0,", ",0,") for line in lines[1:])],
    "a short line": lambda lines: [*lines[:3], "DSC_0009.JPG,1,2", *lines[3:]],
    "no name": lambda lines: [lines[0], lines[1].replace("DSC_0000.JPG", ""), *lines[2:]],
    "a focal length of 0": lambda lines: [lines[0], lines[1].replace("24.5", "0.0"), *lines[2:]],
    "nothing": lambda lines: [],
}


@pytest.mark.parametrize("name", CSV)
def test_a_broken_csv_is_refused_in_a_line(name: str, tmp_path: Path) -> None:
    write_realitycapture(tmp_path)
    file = tmp_path / "cameras.csv"
    file.write_text("\n".join(CSV[name](file.read_text().splitlines())))
    with pytest.raises(DataError, match=r"cameras\.csv") as error:
        realitycapture.read_capture(file)
    assert "\n" not in str(error.value)


def test_what_is_no_text_is_no_csv(tmp_path: Path) -> None:
    (tmp_path / "cameras.csv").write_bytes(b"\xff\xfe\x00#name\x80")
    with pytest.raises(DataError, match="is not a CSV"):
        realitycapture.read_capture(tmp_path / "cameras.csv")


# -- OpenSfM --------------------------------------------------------------------------------------------------------


def test_points_of_opensfm_and_cameras_that_are_not_connected(tmp_path: Path) -> None:
    write_odm(tmp_path / "project")
    _, said = process("odm", tmp_path / "project", tmp_path / "out")
    assert "5 of 6 cameras are placed (left out: 1 in unconnected reconstructions)" in said
    found = read_points(tmp_path / "out" / "sparse_pc.ply").numpy()
    np.testing.assert_allclose(found, [[0.5 * i, 1, -2] for i in range(4)])


def test_an_image_that_was_turned_since_is_left_out(tmp_path: Path) -> None:
    """The camera is for images of another shape, so its lens would fit none of the pixels."""
    write_odm(tmp_path / "project")
    Image.new("RGB", (HEIGHT, WIDTH)).save(tmp_path / "project" / "images" / NAMES[1])
    content, said = process("odm", tmp_path / "project", tmp_path / "out")
    assert [frame["source_path"] for frame in frames_of(content)] == [NAMES[0], *NAMES[2:]]
    assert "1 with an image of another shape" in said


def test_photographs_in_the_output_folder_are_not_removed(tmp_path: Path) -> None:
    write_odm(tmp_path / "project")
    (tmp_path / "out").mkdir()
    photographs = (tmp_path / "project" / "images").rename(tmp_path / "out" / "images")
    words = ("--output-dir", tmp_path / "out", "--images-dir", photographs, "--overwrite")
    done = called("ns-process-data", "odm", "--data", tmp_path / "project", *words)
    assert done.returncode != 0
    assert "overlaps" in " ".join(done.stderr.split())
    assert len(list(photographs.iterdir())) == COUNT


JSON: dict[str, Callable[[Any], Any]] = {
    "an object of nothing": lambda c: {},
    "a number": lambda c: 3,
    "no shots": lambda c: c[0].pop("shots") and c,
    "a shot that is a word": lambda c: c[0]["shots"].update({NAMES[0]: "here"}) or c,
    "another camera": lambda c: c[0]["shots"][NAMES[0]].update(camera="lost") or c,
    "no rotation": lambda c: c[0]["shots"][NAMES[0]].pop("rotation") and c,
    "nan": lambda c: c[0]["shots"][NAMES[0]].update(translation=[0, math.nan, 0]) or c,
    "huge": lambda c: c[0]["shots"][NAMES[0]].update(rotation=[0, 1e300, 0]) or c,
    "a huge integer": lambda c: c[0]["shots"][NAMES[0]].update(rotation=[0, 10**400, 0]) or c,
    "no focal length": lambda c: [lens.pop("focal_x") for lens in c[0]["cameras"].values()] and c,
    "a focal length of 0": lambda c: [lens.update(focal_x=0) for lens in c[0]["cameras"].values()] and c,
    "no width": lambda c: [lens.pop("width") for lens in c[0]["cameras"].values()] and c,
    "a height of 0": lambda c: [lens.update(height=0) for lens in c[0]["cameras"].values()] and c,
    "an endless width": lambda c: [lens.update(width=1e400) for lens in c[0]["cameras"].values()] and c,
    "a point without place": lambda c: c[0]["points"]["2"].pop("coordinates") and c,
}


@pytest.mark.parametrize("name", JSON)
def test_a_broken_reconstruction_is_refused_in_a_line(name: str, tmp_path: Path) -> None:
    file = write_odm(tmp_path) / "opensfm" / "reconstruction.json"
    file.write_text(json.dumps(JSON[name](json.loads(file.read_text()))))
    with pytest.raises(DataError, match=r"reconstruction\.json") as error:
        opensfm.read_capture(file)
    assert "\n" not in str(error.value)


def test_a_projection_that_is_not_supported_is_counted(tmp_path: Path) -> None:
    file = write_odm(tmp_path) / "opensfm" / "reconstruction.json"
    file.write_text(file.read_text().replace('"projection_type": "brown"', '"projection_type": "dual"'))
    capture = opensfm.read_capture(file)
    assert not capture.cameras
    assert "'dual'" in " ".join(capture.left_out)
    with pytest.raises(DataError, match=r"no opensfm/reconstruction\.json"):
        opensfm.find_reconstruction(tmp_path / "opensfm" / "nowhere")


def test_rotations_of_opensfm_by_hand() -> None:
    np.testing.assert_allclose(opensfm.rotation_of(np.zeros(3)), np.eye(3))
    quarter = opensfm.rotation_of(np.array([0, 0, math.pi / 2]))
    np.testing.assert_allclose(quarter, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    tiny = opensfm.rotation_of(np.array([1e-9, 0, 0]))
    np.testing.assert_allclose(tiny, [[1, 0, 0], [0, 1, -1e-9], [0, 1e-9, 1]], atol=1e-17)


# -- Bundler --------------------------------------------------------------------------------------------------------


def test_points_of_bundler_and_cameras_that_are_not_placed(tmp_path: Path) -> None:
    write_bundler(tmp_path)
    flags = ("--bundle", tmp_path / "bundle.out")
    _, said = process("bundler", tmp_path / "photographs", tmp_path / "out", *flags)
    assert "5 of 6 cameras are placed (left out: 1 not aligned)" in said
    found = read_points(tmp_path / "out" / "sparse_pc.ply").numpy()
    np.testing.assert_allclose(found, [[0.5, -1.5, 2.25], [1, 2, 3]])


BUNDLES: dict[str, Callable[[list[str]], list[str]]] = {
    "another header": lambda lines: ["# Bundle file v0.1", *lines[1:]],
    "nothing": lambda lines: [],
    "no counts": lambda lines: [lines[0], "five cameras", *lines[2:]],
    "negative": lambda lines: [lines[0], "-1 2", *lines[2:]],
    "more than there is": lambda lines: [lines[0], "999999999 2", *lines[2:]],
    "cut off": lambda lines: lines[:-4],
    "nan": lambda lines: [*lines[:2], "60.0 nan 0", *lines[3:]],
    "no rotation": lambda lines: [*lines[:3], "9 9 9", *lines[4:]],
    "a short point": lambda lines: [*lines[:-3], "1 2", *lines[-2:]],
}


@pytest.mark.parametrize("name", BUNDLES)
def test_a_broken_bundle_is_refused_in_a_line(name: str, tmp_path: Path) -> None:
    file = write_bundler(tmp_path) / "bundle.out"
    file.write_text("\n".join(BUNDLES[name](file.read_text().splitlines())))
    with pytest.raises(DataError, match=r"bundle\.out") as error:
        bundler.read_capture(file, tmp_path / "list.txt")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("bundle", "listed"),
    [
        ("bundle/bundle.out", "list.txt"),
        ("bundle.out", "list.txt"),
        ("a.bundle.out", "a.list.txt"),
        ("a.out", "a.list.txt"),
    ],
)
def test_the_list_of_images_is_found(bundle: str, listed: str, tmp_path: Path) -> None:
    """Where Bundler writes it, and where COLMAP does; with Windows' mark of UTF-8."""
    write_bundler(tmp_path / "given")
    (tmp_path / bundle).parent.mkdir(exist_ok=True)
    (tmp_path / "given" / "bundle.out").rename(tmp_path / bundle)
    with pytest.raises(DataError, match="--image-list"):
        bundler.find_list(tmp_path / bundle)
    (tmp_path / listed).write_text((tmp_path / "given" / "list.txt").read_text(), encoding="utf-8-sig")
    found = bundler.find_list(tmp_path / bundle)
    assert found.resolve() == (tmp_path / listed).resolve()
    assert [camera.name for camera in bundler.read_capture(tmp_path / bundle, found).cameras] == NAMES


def test_a_list_that_is_too_short(tmp_path: Path) -> None:
    write_bundler(tmp_path)
    (tmp_path / "list.txt").write_text("a.jpg\n")
    with pytest.raises(DataError, match=r"list\.txt lists 1 images"):
        bundler.read_capture(tmp_path / "bundle.out", tmp_path / "list.txt")


# -- the globe ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("longitude", "latitude"), [(0.3, 0.7), (-2.1, -0.4), (1.5, 0.0)])
def test_up_is_the_normal_of_the_ellipsoid(longitude: float, latitude: float) -> None:
    """The position at a geodetic latitude is N cos, N cos, N (b / a)^2 sin with N the radius of curvature."""
    flat = (POLE / EQUATOR) ** 2
    radius = EQUATOR / math.sqrt(math.cos(latitude) ** 2 + flat * math.sin(latitude) ** 2)
    normal = np.array([
        math.cos(latitude) * math.cos(longitude), math.cos(latitude) * math.sin(longitude), math.sin(latitude)
    ])  # fmt: skip
    east, north, up = east_north_up(radius * normal * [1, 1, flat])
    np.testing.assert_allclose(up, normal, atol=1e-12)
    np.testing.assert_allclose(east, [-math.sin(longitude), math.cos(longitude), 0], atol=1e-12)
    np.testing.assert_allclose(np.linalg.det([east, north, up]), 1)


def test_at_a_pole_there_is_a_frame_too() -> None:
    rotation = east_north_up(np.array([0, 0, POLE]))
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(rotation[2], [0, 0, 1])


def test_the_chunk_is_not_applied_where_a_component_has_its_own(tmp_path: Path) -> None:
    component = f'<components><component id="0">{transform(CHUNK)}</component></components>'
    cameras = all_cameras('component_id="0"')
    other = transform((np.eye(3), np.array([100.0, 0, 0]), 7.0))
    capture = metashape.read_capture(write_cameras(tmp_path, sensor(0, "frame", FRAME), cameras, component + other))
    for index, item in enumerate(capture.cameras):
        np.testing.assert_allclose(item.pose[:3, 3], to_world(index, np.zeros((1, 3)))[0], atol=1e-12)
