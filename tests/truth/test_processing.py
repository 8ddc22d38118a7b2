"""A capture with a known truth, through ns-process-data: its files show the same ball, in the same frame."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from nerfloom.base.json_files import write_json
from nerfloom.data.dataset import load_dataset
from nerfloom.data.ply import read_points
from nerfloom.dataparsers.nerfstudio import Nerfstudio
from nerfloom.processing import transforms
from tests.cli.helpers import called
from tests.processing.known_poses import without_colmap
from tests.processing.programs import document, numbers, sensor
from tests.truth.ball import (
    CENTRE,
    COUNT,
    HEIGHT,
    NAMES,
    PINHOLE,
    RADIUS,
    WIDTH,
    Lens,
    photograph,
    pose_of,
    write_photographs,
)
from tests.truth.formats import COLMAP_CAMERAS, camera_line, model_of, write_polycam, write_record3d
from tests.truth.test_captures import assert_pixels_show_the_ball, in_own_frame

WRITABLE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE")
"""COLMAP's models that ns-process-data fits and transforms.json has a place for."""
EVERY = Nerfstudio(eval_mode="all")


def process(kind: str, data: Path, output: Path, *flags: object) -> dict[str, Any]:
    """Run ns-process-data; returns transforms.json."""
    done = called("ns-process-data", kind, "--data", data, "--output-dir", output, *flags)
    assert done.returncode == 0, done.stderr
    content: dict[str, Any] = json.loads((output / "transforms.json").read_text())
    return content


@pytest.mark.medium
@pytest.mark.parametrize("model", WRITABLE)
def test_photographs_with_the_poses_and_the_lens_that_colmap_finds(
    model: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    order, lens = COLMAP_CAMERAS[model]
    write_photographs(tmp_path / "photographs", NAMES, lens)
    without_colmap(monkeypatch, camera_line(model, order, lens), model_of())
    output = tmp_path / "out"
    content = process("images", tmp_path / "photographs", output, "--num-downscales", 1)
    assert len(content["frames"]) == COUNT
    scene = EVERY.parse(output, "train")
    assert_pixels_show_the_ball(scene, None)
    assert scene.transform is not None
    assert scene.points is not None
    turn, move = scene.transform[:, :3].double().numpy(), scene.transform[:, 3].double().numpy()
    points = (scene.points.double().numpy() / scene.scale - move) @ turn
    np.testing.assert_allclose(np.linalg.norm(points - CENTRE, axis=-1), RADIUS, rtol=1e-5)
    # The file's own frame has z up, as COLMAP's has -y.
    expected = model_of().points[:, [0, 2, 1]] * [1, 1, -1]
    stored = read_points(output / "sparse_pc.ply").numpy()
    np.testing.assert_allclose(stored[stored[:, 0].argsort()], expected[expected[:, 0].argsort()], atol=1e-6)
    half = Nerfstudio(eval_mode="all", downscale_factor=2).parse(output, "train")
    assert {path.parent.name for path in half.image_paths} == {"images_2"}
    assert_reduced_rays_agree(half, scene)


def assert_reduced_rays_agree(half: Any, whole: Any) -> None:
    """A pixel reduced by 2 looks where the middle of its four does, and is their mean weighted by alpha."""
    small, large = load_dataset(half, "a"), load_dataset(whole, "a")
    for index in (0, COUNT - 1):
        at = torch.tensor([index])
        coarse = small.cameras.rays(at, torch.tensor([7.0]), torch.tensor([11.0]), 0.0, 1.0)
        finer = large.cameras.rays(at, torch.tensor([14.5]), torch.tensor([22.5]), 0.0, 1.0)
        for one, other in zip(in_own_frame(half, coarse), in_own_frame(whole, finer), strict=True):
            np.testing.assert_allclose(one, other, atol=1e-6)
        blocks = large.image(index).double().numpy().reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 4)
        alpha = blocks[..., 3:].sum((1, 3))
        seen = alpha[..., 0] > 0
        colors = (blocks[..., :3] * blocks[..., 3:]).sum((1, 3))[seen] / alpha[seen]
        stored = small.image(index).double().numpy()
        assert np.abs(stored[seen][:, :3] - colors).max() <= 3  # Pillow rounds before it divides by alpha
        assert np.abs(stored[..., 3] - alpha[..., 0] / 4).max() <= 1


def test_a_mask_comes_with_its_photograph_and_a_reduced_one_is_white_where_all_of_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_photographs(tmp_path / "photographs", NAMES)
    (tmp_path / "masks").mkdir()
    white = np.zeros((HEIGHT, WIDTH), bool)
    white[3:, : WIDTH - 5] = True
    for index, name in enumerate(NAMES):
        Image.fromarray(np.roll(white, index, 1).astype(np.uint8) * 255).save(tmp_path / "masks" / name)
    order, lens = COLMAP_CAMERAS["PINHOLE"]
    without_colmap(monkeypatch, camera_line("PINHOLE", order, lens), model_of())
    output = tmp_path / "out"
    process("images", tmp_path / "photographs", output, "--masks-dir", tmp_path / "masks", "--num-downscales", 1)
    for factor in (1, 2):
        data = load_dataset(Nerfstudio(eval_mode="all", downscale_factor=factor).parse(output, "train"), "a")
        for index in range(COUNT):
            kept = data.kept_of(index)
            assert kept is not None
            expected = np.roll(white, index, 1).reshape(HEIGHT // factor, factor, WIDTH // factor, factor).all((1, 3))
            assert np.array_equal(kept.numpy(), expected)


def test_photographs_of_a_phone_that_was_turned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stored a quarter turn to the left, with the EXIF note to turn them to the right."""
    (tmp_path / "photographs").mkdir()
    exif = Image.Exif()
    exif[0x0112] = 6
    for index, name in enumerate(NAMES):
        turned = np.ascontiguousarray(np.rot90(photograph(index)))
        Image.fromarray(turned).save(tmp_path / "photographs" / name, exif=exif)
    order, lens = COLMAP_CAMERAS["PINHOLE"]
    without_colmap(monkeypatch, camera_line("PINHOLE", order, lens), model_of())
    process("images", tmp_path / "photographs", tmp_path / "out", "--num-downscales", 0)
    assert_pixels_show_the_ball(EVERY.parse(tmp_path / "out", "train"), None)


@pytest.mark.parametrize("crop", [0, 3])
def test_polycam(crop: int, tmp_path: Path) -> None:
    write_polycam(tmp_path / "capture")
    content = process(
        "polycam", tmp_path / "capture", tmp_path / "out", "--crop-border-pixels", crop, "--num-downscales", 0
    )
    assert (content["w"], content["h"]) == (WIDTH - 2 * crop, HEIGHT - 2 * crop)
    assert len(content["frames"]) == COUNT
    assert (np.array(content["applied_transform"])[:, :3] @ [0, 1, 0]).tolist() == [0, 0, 1]  # y becomes z
    assert_pixels_show_the_ball(EVERY.parse(tmp_path / "out", "train"), None)


@pytest.mark.parametrize("each", [False, True])
def test_record3d(each: bool, tmp_path: Path) -> None:
    write_record3d(tmp_path / "capture")
    if each:  # K is of the whole recording, and wrong then
        file = tmp_path / "capture" / "EXR_RGBD" / "metadata.json"
        found = json.loads(file.read_text())
        found["K"][0] *= 2
        file.write_text(json.dumps({**found, "perFrameIntrinsicCoeffs": [list(PINHOLE.intrinsics)] * COUNT}))
    content = process("record3d", tmp_path / "capture", tmp_path / "out", "--num-downscales", 0)
    assert len(content["frames"]) == COUNT
    assert_pixels_show_the_ball(EVERY.parse(tmp_path / "out", "train"), None)


def test_a_lens_of_each_photograph(tmp_path: Path) -> None:
    """Two cameras took turns: their intrinsics stand with each frame."""
    lenses = [
        Lens("opencv", {"k1": -0.11, "p2": 0.01}),
        Lens("opencv", {"k1": 0.08, "p1": -0.01}, (66.0, 64.0, 25, 19)),
    ]
    (tmp_path / "images").mkdir()
    frames = []
    for index, name in enumerate(NAMES):
        lens = lenses[index % 2]
        Image.fromarray(photograph(index, lens)).save(tmp_path / "images" / name)
        values = [*lens.intrinsics, *(lens.named.get(key, 0.0) for key in ("k1", "k2", "p1", "p2"))]
        written = transforms.lens_of("OPENCV", WIDTH, HEIGHT, values)
        model = model_of()
        world_to_camera = np.concatenate([model.rotations[index], model.translations[index][:, None]], 1)
        pose = transforms.transformed(transforms.opengl_pose(world_to_camera), transforms.Z_UP)
        frames.append(transforms.Frame(name, pose, written))
    write_json(tmp_path / "transforms.json", transforms.content(frames, transforms.Z_UP, None, {}))
    assert_pixels_show_the_ball(EVERY.parse(tmp_path, "train"), None)


@pytest.mark.parametrize("kind", ["frame", "fisheye"])
def test_metashape(kind: str, tmp_path: Path) -> None:
    """Its lens by its own names: the principal point from the centre, and tangential coefficients exchanged."""
    named = {"k1": 0.06, "k2": -0.09, "k3": 0.2, "k4": -0.4}
    if kind == "frame":
        named = {"k1": -0.11, "k2": 0.02, "k3": 0.01, "k7": 0.03, "p1": 0.008, "p2": -0.012}
    lens = Lens("opencv" if kind == "frame" else "fisheye", named)
    write_photographs(tmp_path / "photographs", NAMES, lens)
    fx, fy, cx, cy = lens.intrinsics
    calibration = {"f": fy, "b1": fx - fy, "cx": cx - WIDTH / 2, "cy": cy - HEIGHT / 2}
    calibration |= {"p1": named.get("p2", 0.0), "p2": named.get("p1", 0.0), "k4": named.get("k7", named.get("k4", 0.0))}
    calibration |= {name: named[name] for name in ("k1", "k2", "k3")}
    cameras = ""
    for index, name in enumerate(NAMES):
        matrix = pose_of(index) @ np.diag([1.0, -1, -1, 1])
        moved = f"<transform>{numbers(matrix)}</transform>"
        cameras += f'<camera id="{index}" sensor_id="0" label="{name}">{moved}</camera>'
    text = document(sensor(0, kind, calibration, (WIDTH, HEIGHT)), cameras)
    (tmp_path / "cameras.xml").write_text(text)
    flags = ("--xml", tmp_path / "cameras.xml", "--num-downscales", 0)
    content = process("metashape", tmp_path / "photographs", tmp_path / "out", *flags)
    assert len(content["frames"]) == COUNT
    assert_pixels_show_the_ball(EVERY.parse(tmp_path / "out", "train"), None)
