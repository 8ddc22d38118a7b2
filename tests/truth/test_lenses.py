"""Wide lenses on the way from COLMAP to rays: read directly, and by way of the files of ns-process-data.

So wide that every coefficient moves the picture's edge by a tenth of a pixel or more: a lost or exchanged coefficient
shows. Rays are compared with OpenCV's formulas, undone by iteration (`ball.Lens`).
"""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfloom import ParsedScene
from nerfloom.base.json_files import write_json
from nerfloom.dataparsers.colmap import Colmap
from nerfloom.dataparsers.nerfstudio import Nerfstudio
from nerfloom.processing import transforms
from tests.dataparsers.sparse_models import write_colmap
from tests.truth.ball import HEIGHT, NAMES, WIDTH, Lens, opencv_pose, pose_of, write_photographs
from tests.truth.formats import COLMAP_CAMERAS, camera_line, model_of
from tests.truth.test_captures import in_own_frame
from tests.truth.test_processing import WRITABLE

WIDE, WIDE_ONE = (24.0, 25.0, 23.1, 20.7), (24.0, 24.0, 23.1, 20.7)
BENDING = {
    "k1": -0.06, "k2": 0.03, "p1": 0.005, "p2": -0.007, "k3": 0.011, "k4": 0.023, "k5": -0.013, "k6": 0.009,
    "k7": -0.004,
}  # fmt: skip
FISHEYE = {"k1": 0.05, "k2": -0.04, "k3": 0.03, "k4": -0.01}


def wide(model: str) -> Lens:
    """A lens with all coefficients that a COLMAP model has."""
    order = COLMAP_CAMERAS[model][0].split()
    intrinsics = WIDE_ONE if "f" in order else WIDE
    if "FISHEYE" in model:
        return Lens("fisheye", {name: value for name, value in FISHEYE.items() if name in order}, intrinsics)
    named = {name: value for name, value in BENDING.items() if name in order}
    return Lens("opencv" if named else "pinhole", named, intrinsics)


def assert_rays_are_the_lens(scene: ParsedScene, lens: Lens) -> None:
    """Check the rays of all pixels of the first and the last photograph, in the capture's own frame."""
    assert [path.name for path in scene.image_paths] == NAMES
    for index in (0, len(NAMES) - 1):
        rays = scene.cameras.pixel_rays(scene.cameras.image_pixels(index), 0.0, 1.0)
        origins, directions = in_own_frame(scene, rays)
        off = np.linalg.norm(directions - lens.local @ pose_of(index)[:3, :3].T, axis=-1).max()
        assert off < 1e-5
        np.testing.assert_allclose(origins, np.broadcast_to(pose_of(index)[:3, 3], origins.shape), atol=1e-5)


def test_every_coefficient_matters() -> None:
    for model in COLMAP_CAMERAS:
        lens = wide(model)
        for name in lens.named:
            other = Lens(lens.model, {key: value for key, value in lens.named.items() if key != name}, lens.intrinsics)
            assert np.linalg.norm(lens.local - other.local, axis=-1).max() > 1e-3, (model, name)


@pytest.mark.parametrize("model", COLMAP_CAMERAS)
def test_colmaps_cameras(model: str, tmp_path: Path) -> None:
    lens = wide(model)
    write_photographs(tmp_path / "images", NAMES)
    write_colmap(tmp_path / "sparse" / "0", model_of(), camera_line(model, COLMAP_CAMERAS[model][0], lens))
    assert_rays_are_the_lens(Colmap(eval_interval=0).parse(tmp_path, "train"), lens)


@pytest.mark.parametrize("model", WRITABLE)
def test_colmaps_cameras_as_they_are_written_and_read(model: str, tmp_path: Path) -> None:
    lens = wide(model)
    values = [float(word) for word in camera_line(model, COLMAP_CAMERAS[model][0], lens).split()[3:]]
    written = transforms.lens_of(model, WIDTH, HEIGHT, values)
    frames = [
        transforms.Frame(
            name, transforms.transformed(transforms.opengl_pose(opencv_pose(index)), transforms.Z_UP), written
        )
        for index, name in enumerate(NAMES)
    ]
    write_json(tmp_path / "transforms.json", transforms.content(frames, transforms.Z_UP, None, {}))
    write_photographs(tmp_path / "images", NAMES)
    assert_rays_are_the_lens(Nerfstudio(eval_mode="all").parse(tmp_path, "train"), lens)


@pytest.mark.parametrize(
    ("model", "names"),
    [
        ("OPENCV", {"k1": "k1", "k2": "k2", "p1": "p1", "p2": "p2", "k3": "k3", "k7": "k4"}),
        ("FULL_OPENCV", {name: name for name in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")}),
        ("OPENCV_FISHEYE", {name: name for name in FISHEYE}),
    ],
)
@pytest.mark.parametrize("each", [False, True])
def test_a_file_of_nerfstudio(model: str, names: dict[str, str], each: bool, tmp_path: Path) -> None:
    """Coefficients are for all photographs, or with each; the fourth of OPENCV belongs to r^8."""
    values, kind = (FISHEYE, "fisheye") if model == "OPENCV_FISHEYE" else (BENDING, "opencv")
    lens = Lens(kind, {name: values[name] for name in names}, WIDE)
    written = {written: values[name] for name, written in names.items()}
    frames = [
        {"file_path": f"images/{name}", "transform_matrix": pose_of(index).tolist(), **(written if each else {})}
        for index, name in enumerate(NAMES)
    ]
    fx, fy, cx, cy = WIDE
    content = {"camera_model": model, "w": WIDTH, "h": HEIGHT, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    (tmp_path / "transforms.json").write_text(json.dumps({**content, **({} if each else written), "frames": frames}))
    write_photographs(tmp_path / "images", NAMES)
    scene = Nerfstudio(eval_mode="all").parse(tmp_path, "train")
    assert_rays_are_the_lens(scene, lens)
    indices = torch.zeros(3, dtype=torch.long)
    spots = torch.tensor([3.0, 20.0, 44.0]), torch.tensor([2.0, 30.0, 37.0])
    rays = scene.cameras.rays(indices, *spots, 0.0, 1.0)
    back = scene.cameras.project(rays.points(torch.arange(3), torch.tensor([1.0, 2.0, 5.0])), 0)
    for found, given in zip(back, spots, strict=False):
        torch.testing.assert_close(found, given, atol=1e-3, rtol=0)
