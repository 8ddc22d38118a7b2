"""transforms.json as it is written, read back by the format's parser; and the folder it is in."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from nerfloom.base.errors import DataError
from nerfloom.base.json_files import write_json
from nerfloom.dataparsers.nerfstudio import Nerfstudio
from nerfloom.processing import transforms
from nerfloom.processing.output import check_apart, claim


def world_to_camera(index: int) -> np.ndarray:
    draws = np.random.default_rng(index)
    q, _ = np.linalg.qr(draws.normal(size=(3, 3)))
    return np.concatenate([q * np.linalg.det(q), draws.normal(size=(3, 1))], axis=1)


def test_points_are_seen_where_colmap_sees_them(tmp_path: Path) -> None:
    """COLMAP's own equations and the files written and read back agree."""
    (tmp_path / "images").mkdir()
    lens = transforms.lens_of("PINHOLE", 64, 48, [50.0, 52.0, 31.0, 25.0])
    frames = []
    for index in range(8):
        name = f"{index}.png"
        Image.new("RGB", (64, 48)).save(tmp_path / "images" / name)
        pose = transforms.transformed(transforms.opengl_pose(world_to_camera(index)), transforms.Z_UP)
        frames.append(transforms.Frame(name, pose, lens))
    write_json(tmp_path / "transforms.json", transforms.content(frames, transforms.Z_UP, None, {}))
    scene = Nerfstudio(eval_interval=0).parse(tmp_path, "train")
    assert scene.transform is not None
    draws = np.random.default_rng(9)
    for index in range(8):
        extrinsic = world_to_camera(index)
        column, row, depth = draws.uniform(1, 63), draws.uniform(1, 47), 3.0
        local = np.array([(column - 31) / 50 * depth, (row - 25) / 52 * depth, depth])
        point = extrinsic[:, :3].T @ (local - extrinsic[:, 3])
        inside = scene.placement.points(torch.tensor(point)[None])[0].float()
        at = torch.tensor([index])
        found = scene.cameras.project(inside[None], at)
        assert float(found[0][0]) == pytest.approx(column - 0.5, abs=0.01)
        assert float(found[1][0]) == pytest.approx(row - 0.5, abs=0.01)
        assert bool(found[2][0])


def test_lenses_of_colmap() -> None:
    radial = transforms.lens_of("SIMPLE_RADIAL", 10, 8, [5.0, 4.0, 3.0, 0.1])
    assert radial.model == "OPENCV"
    assert radial.values["fl_x"] == radial.values["fl_y"] == 5
    assert (radial.values["k1"], radial.values["k2"]) == (0.1, 0)
    with pytest.raises(DataError, match="FOV"):
        transforms.lens_of("FOV", 10, 8, [5.0, 5.0, 4.0, 3.0, 0.1])


def test_a_folder_with_something_in_it_is_refused_unless_it_may_be_replaced(tmp_path: Path) -> None:
    data, output = tmp_path / "in", tmp_path / "out"
    data.mkdir()
    output.mkdir()
    claim(output, data, False)
    (output / "transforms.json").write_text("{}")
    (output / "images_2").mkdir()
    (output / "notes.txt").write_text("mine")
    with pytest.raises(DataError, match="has a processed data set"):
        claim(output, data, False)
    claim(output, data, True)
    assert [path.name for path in output.iterdir()] == ["notes.txt"]
    inner = output / "images"
    inner.mkdir()
    with pytest.raises(DataError, match="would remove"):
        claim(output, inner, True)
    with pytest.raises(DataError, match="choose another folder"):
        check_apart(data, data)
